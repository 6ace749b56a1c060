"""Tickets of projector windows: they let a window be the projector again after a restart of the server.

A window on the second monitor has no keyboard, and nobody looks at it between scans: it can't log in
again when the sessions are gone. Its ticket is worth nothing but being a projector page.
"""

import hashlib
import hmac
import time
from collections.abc import Callable
from functools import cached_property

_PURPOSE = b"unglare projector page"
_GUESSING_COST = 2**12
"""Of `hashlib.scrypt`, about 10 ms: whoever gets hold of a ticket could try out short tokens on it, past the login's limit."""


class PageTickets:
    """Makes tickets and recognises its own; nothing is kept, so they outlive the process.

    Parameters
    ----------
    operator_token
        The operators' token: with another one, all tickets are void.
    lifetime_s
        A ticket holds so long after the page was loaded [s].
    clock
        Seconds since 1970: a ticket is older than the process that checks it.
    """

    def __init__(
        self,
        operator_token: str,
        *,
        lifetime_s: float = 30 * 24 * 3600.0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._token = operator_token.encode("utf-8", "surrogatepass")
        self._lifetime_s = lifetime_s
        self._clock = clock

    @property
    def lifetime_s(self) -> float:
        """How long a ticket holds [s]."""
        return self._lifetime_s

    def issue(self) -> str:
        """Return a ticket for the window of an operator."""
        until_s = int(self._clock() + self._lifetime_s)
        return f"{until_s}.{self._signature(until_s)}"

    def holds(self, ticket: str) -> bool:
        """Tell whether this is a ticket of ours that hasn't run out."""
        until, _, signature = ticket.partition(".")
        # isdecimal takes digits of all scripts, and int a number of any length.
        if not (until.isascii() and until.isdecimal() and len(until) <= 12):
            return False
        genuine = hmac.compare_digest(
            signature.encode("utf-8", "surrogatepass"), self._signature(int(until)).encode()
        )
        return genuine and self._clock() < int(until)

    @cached_property
    def _key(self) -> bytes:
        return hashlib.scrypt(self._token, salt=_PURPOSE, n=_GUESSING_COST, r=8, p=1, dklen=32)

    def _signature(self, until_s: int) -> str:
        return hmac.new(self._key, str(until_s).encode(), hashlib.sha256).hexdigest()
