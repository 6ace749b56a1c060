"""Captured frames: one picture per camera out of a list, chosen by exposure and pattern."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from app.client import picture_address
from app.numbers import quantity
from app.views.picture import Figure
from backend.contract.scans import FrameRef

_FULL_PX = 4096
_ANGLE = "_rad"


@dataclass(frozen=True)
class FrameMenu:
    """What can be chosen: exposures and, at each of them, patterns."""

    frames: tuple[FrameRef, ...]

    def exposures(self) -> list[str]:
        """Return the exposures in the order of capture."""
        return list(dict.fromkeys(_exposure(f) for f in self.frames))

    def patterns(self) -> list[str]:
        """Return the patterns in the order of capture."""
        return list(dict.fromkeys(pattern_text(f.pattern) for f in self.frames))

    def pick(self, exposure: str, pattern: str) -> list[FrameRef]:
        """Return one frame per camera: of this exposure and pattern, else of what comes nearest."""
        found: dict[str, FrameRef] = {}
        for wanted in ((exposure, pattern), (exposure, None), (None, None)):
            for frame in self.frames:
                if frame.camera not in found and _fits(frame, *wanted):
                    found[frame.camera] = frame
        return list(found.values())


def frame_figure(frame: FrameRef, *, max_px: int) -> Figure:
    """Describe a frame as a picture, black to full scale."""
    top = 2.0**frame.bit_depth - 1.0
    height, width = frame.image.shape[:2]
    addresses = (
        picture_address(frame.image.hash, max_px=px, low=0.0, high=top) for px in (max_px, _FULL_PX)
    )
    small, full = addresses
    return Figure(frame.camera, small, full, width, height, frame.image.hash)


def pattern_text(pattern: dict[str, Any]) -> str:
    """Describe a pattern in words, whatever kind it is.

    Examples
    --------
    >>> pattern_text({"kind": "sine", "axis": "x", "periods": 70.0, "shift_rad": 1.5708})
    'sine x · 70 periods · shift 90°'
    """
    axis = f" {pattern['axis']}" if "axis" in pattern else ""
    words = [f"{pattern.get('kind', 'picture')}{axis}"]
    for name, value in pattern.items():
        if name in ("kind", "axis") or value is None or value is False:
            continue
        words.append(_property(name, value))
    return " · ".join(words)


def _property(name: str, value: Any) -> str:
    if name.endswith(_ANGLE) and isinstance(value, (int, float)):
        return f"{name.removesuffix(_ANGLE)} {math.degrees(value):.0f}°"
    if value is True:
        return name.replace("_", " ")
    if name == "periods":
        return f"{quantity(value)} periods"
    return f"{name.replace('_', ' ')} {quantity(value)}"


def _exposure(frame: FrameRef) -> str:
    return "exposure unknown" if frame.exposure_ms is None else quantity(frame.exposure_ms, "ms")


def _fits(frame: FrameRef, exposure: str | None, pattern: str | None) -> bool:
    return (exposure is None or _exposure(frame) == exposure) and (
        pattern is None or pattern_text(frame.pattern) == pattern
    )


def cameras_of(frames: Sequence[FrameRef]) -> list[str]:
    """Return the cameras in the order of capture."""
    return list(dict.fromkeys(f.camera for f in frames))
