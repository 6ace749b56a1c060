"""Small captured folders for tests: a few gray pictures with a `capture.json`, and what may be wrong with them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import Float

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.hints import Frames, Picture, Value
from backend.domain.method import Method
from backend.domain.params import Params, setting
from backend.domain.patterns import Uniform
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.methods import Registry

WIDTH, HEIGHT = 8, 6


class LevelsParams(Params):
    """Which levels are projected."""

    levels_gray: tuple[float, ...] = setting((0.0, 100.0, 200.0), title="Levels", unit="gray")
    exposure_ms: float = setting(10.0, title="Exposure", unit="ms", gt=0)


@dataclass(frozen=True)
class Levels:
    """Pictures of uniform fields."""

    frames: Annotated[tuple[Frame, ...], Frames("Fields")]


@stage(title="Levels", version=1)
def levels(facts: RigFacts, params: LevelsParams, shoot: Shoot) -> Levels:
    """Capture uniform fields."""
    return shoot(levels_plan(params))


def levels_plan(params: LevelsParams) -> Plan[Levels]:
    exposed = yield tuple(Shot(Uniform(gray=g), params.exposure_ms) for g in params.levels_gray)
    return Levels(tuple(frame for shot in exposed for frame in shot.values()))


def import_levels(frames: tuple[Frame, ...]) -> Levels:
    if len(frames) < 2:
        raise InvalidCaptureError(f"Two fields are needed, there is {len(frames)}.")
    return Levels(frames)


class MeanParams(Params):
    """How the mean is taken."""

    scale: float = setting(1.0, title="Scale", gt=0, le=10)


@dataclass(frozen=True)
class Mean:
    """Mean of all fields."""

    mean_gray: Annotated[Float[np.ndarray, "h w"], Picture("Mean", unit="gray")]
    level: Annotated[float, Value("Level", unit="gray")]
    has_calibration: bool


@stage(title="Mean", version=1)
def mean(levels: Levels, calibration: RigCalibration | None, params: MeanParams) -> Mean:
    """Take the mean of all fields."""
    stack = np.stack([f.gray for f in levels.frames]).astype(np.float64)
    picture = stack.mean(axis=0) * params.scale
    return Mean(picture, float(picture.mean()), calibration is not None)


LEVELS = Method("levels", "Levels", (levels, mean), importers={"levels": import_levels})


def registry() -> Registry:
    return Registry({"levels": LEVELS})


def capture_document(**changes: Any) -> dict[str, Any]:
    frames = [
        {
            "file": f"{gray}.png",
            "camera": "main",
            "exposure_ms": 10.0,
            "pattern": {"kind": "uniform", "gray": gray},
        }
        for gray in (0, 100, 200)
    ]
    camera = {"width_px": WIDTH, "height_px": HEIGHT, "bit_depth": 8}
    return {
        "format": "unglare-capture", "version": 1, "name": "three levels", "method": "levels",
        "cameras": {"main": camera}, "frames": frames, **changes,
    }  # fmt: skip


def picture(gray: int, dtype: type = np.uint8) -> np.ndarray[Any, np.dtype[Any]]:
    ramp: np.ndarray[Any, np.dtype[Any]] = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH))
    return (ramp + gray).astype(dtype)


def write_capture(
    folder: Path, change: Callable[[dict[str, Any], Path], None] | None = None
) -> Path:
    """Write a folder that can be imported; `change` may then break document and pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    document = capture_document()
    for gray in (0, 100, 200):
        cv2.imwrite(str(folder / f"{gray}.png"), picture(gray))
    if change:
        change(document, folder)
    (folder / "capture.json").write_text(json.dumps(document))
    return folder
