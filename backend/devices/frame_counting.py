"""Frame numbers that don't wrap, out of the block numbers that cameras send."""

_WRAP = 0xFFFF
"""GigE Vision counts frames from 1 to 65535, and then from 1 again."""
_INVALID = 0xFFFF_FFFF_FFFF_FFFF
"""What libraries call the block of a frame that failed before its number came."""


class FrameCounter:
    """Counts frames over all acquisitions; a block number that is left out is a lost frame, and a gap here.

    Parameters
    ----------
    first_block
        What an acquisition's first frame has; also a camera that begins at 0 is understood. None: not known, an
        acquisition's first frame is simply the next one.

    Examples
    --------
    >>> counter = FrameCounter()
    >>> [counter.count(block) for block in (1, 2, 4)]
    [0, 1, 3]
    """

    def __init__(self, first_block: int | None = 1) -> None:
        self._first_block = first_block
        self._number = -1
        self.restart()

    def restart(self) -> None:
        """Begin with a new acquisition, whose blocks count from the first again; ours go on."""
        self._last = None if self._first_block is None else self._first_block - 1

    def count(self, block: int) -> int:
        """Return the running number of a frame; the block of a camera that doesn't count never changes."""
        if block == _INVALID:
            self._number += 1
            self._last = None if self._last is None else self._last + 1
            return self._number
        step = 1 if self._last is None else block - self._last
        self._number += max(step % _WRAP if step < 0 else step, 1)
        self._last = block
        return self._number
