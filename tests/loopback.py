"""Loopback addresses that nobody else on this machine uses: all of 127.0.0.0/8 is this machine.

Two test processes, or two runs of the tests at once, never get the same one; neither do two tests one after the
other, so nobody meets what an earlier test has left behind.
"""

import itertools
import os

_NUMBERS = itertools.cycle(range(2, 255))


def loopback_address() -> str:
    """Return an address of this process, another one each time."""
    high, low = divmod(os.getpid(), 256)
    return f"127.{64 + high % 128}.{low}.{next(_NUMBERS)}"
