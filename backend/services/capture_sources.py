"""What can be imported: captured folders of our own format, and files of other programs."""

from collections.abc import Callable
from pathlib import Path

from backend.services.capture_folder import CaptureFolder, open_capture
from backend.services.sofast_capture import looks_like_sofast, open_sofast

FOREIGN: tuple[tuple[Callable[[Path], bool], Callable[[Path], CaptureFolder]], ...] = (
    (looks_like_sofast, open_sofast),
)
"""Other programs' files: how they are recognised, and read."""


def is_foreign(path: Path) -> bool:
    """Tell whether another program's file (or folder of files) is there."""
    return any(looks(path) for looks, _ in FOREIGN)


def open_source(path: Path) -> CaptureFolder:
    """Read and check a capture, whoever wrote it; its pictures follow one by one.

    Raises
    ------
    InvalidCaptureError, InvalidCalibrationError
        In one sentence: what is wrong with which file.
    """
    for looks, read in FOREIGN:
        if looks(path):
            return read(path)
    return open_capture(path)
