"""Whether frames come in order: none twice, none missing, at the pace of the display that triggered them."""

from collections.abc import Mapping, Sequence

import numpy as np

from backend.devices.errors import IncompleteFrame
from backend.devices.protocols import Frame

TOLERANCE = 0.25
"""Share of the period that a hardware-timed frame may be early or late by, by its camera's clock."""


class FrameOrder:
    """Remembers the number of each camera's last frame, from one shot to the next."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def forget(self, camera: str) -> None:
        """Take the next frame as it comes: the camera was armed anew, or a frame of it was lost and taken again."""
        self._last.pop(camera, None)

    def check(self, camera: str, frame: Frame, *, gaps: bool = False) -> None:
        """Look at a frame's number; `gaps` are allowed where a camera runs freely.

        Raises
        ------
        IncompleteFrame
            If the frame came before, or others are missing before it: what it shows isn't certain.
        """
        last = self._last.get(camera)
        self._last[camera] = frame.frame_id
        if last is None:
            return
        if frame.frame_id <= last:
            raise IncompleteFrame(camera, f"frame {frame.frame_id} came again; take it again")
        if frame.frame_id > last + 1 and not gaps:
            raise IncompleteFrame(
                camera,
                f"frame {frame.frame_id} came after frame {last}, the ones between are missing; take it again",
            )


def check_sequence(frames: Mapping[str, Sequence[Frame]], period_s: float) -> None:
    """Look at the frames of a hardware-timed sequence: consecutive numbers, equal distances in time, cameras in step.

    Raises
    ------
    IncompleteFrame
        If they aren't: the sentence names the first frame that is out of order.
    """
    for camera, taken in frames.items():
        _check_numbers(camera, taken)
        _check_distances(camera, taken, period_s)
    _check_skew(frames, period_s)


def _check_numbers(camera: str, taken: Sequence[Frame]) -> None:
    first = taken[0].frame_id
    for n, frame in enumerate(taken):
        if frame.frame_id != first + n:
            raise IncompleteFrame(
                camera,
                f"frame {n + 1} of {len(taken)} of the sequence has number {frame.frame_id}, {first + n} was due: an edge"
                " of the trigger line was missed or came twice; check the line, or leave the camera more time",
            )


def _check_distances(camera: str, taken: Sequence[Frame], period_s: float) -> None:
    stamps = [frame.timestamp_s for frame in taken]
    if len(stamps) < 2 or None in stamps:
        return
    distances_s = np.diff(np.array(stamps, np.float64))
    wrong = np.flatnonzero(np.abs(distances_s - period_s) > TOLERANCE * period_s)
    if wrong.size:
        n = int(wrong[0]) + 1
        raise IncompleteFrame(
            camera,
            f"frame {n + 1} of {len(taken)} of the sequence was exposed {1e3 * distances_s[n - 1]:.2f} ms after the one"
            f" before, {1e3 * period_s:.2f} ms were due: an edge of the trigger line was missed; check the line, or leave"
            " the camera more time",
        )


def _check_skew(frames: Mapping[str, Sequence[Frame]], period_s: float) -> None:
    """Compare cameras' clocks, whose distance is any but the same all along."""
    names = [name for name, taken in frames.items() if taken[0].timestamp_s is not None]
    for name in names[1:]:
        pairs = zip(frames[names[0]], frames[name], strict=True)
        skew_s = np.array([(b.timestamp_s or 0.0) - (a.timestamp_s or 0.0) for a, b in pairs])
        off_s = np.abs(skew_s - np.median(skew_s))
        worst = int(np.argmax(off_s))
        if off_s[worst] > TOLERANCE * period_s:
            raise IncompleteFrame(
                name,
                f"frame {worst + 1} of {len(skew_s)} of the sequence is {1e3 * off_s[worst]:.2f} ms out of step with"
                f" camera {names[0]}; check the trigger lines",
            )
