"""Names of things: scans, stage runs, jobs. Sortable by time, safe in addresses and file names."""

import secrets
import time

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"  # Crockford's base 32: no i, l, o, u


def new_id() -> str:
    """Make an id of 16 characters that sorts by the time of its making, e.g. `01m2k8v0q4x9h3tz`."""
    number = (time.time_ns() // 1_000_000) << 30 | secrets.randbits(30)
    return _base32(number)[-16:].rjust(16, "0")


def _base32(number: int) -> str:
    digits = ""
    while number:
        number, digit = divmod(number, 32)
        digits = _ALPHABET[digit] + digits
    return digits
