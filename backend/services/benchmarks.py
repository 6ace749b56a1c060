"""A small benchmark that needs nothing but the application: whether this machine is fast enough.

Times are the best of several rounds and stand beside the time of copying the same frames in the same run, so
that they can be compared between machines.
"""

import ctypes
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from backend.devices.sim import create_rig
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Sine
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Progress
from backend.numerics.absolute_phase import decode_frames, empty_maps
from backend.numerics.camera_model import Pinhole, RigidTransform, inverse, project, rays
from backend.numerics.fringe_orders import maximum_likelihood
from backend.numerics.matching import Matches, match
from backend.numerics.rectification import Rectification, rectify
from backend.numerics.sine_code import SineCode
from backend.numerics.triangulation import triangulate_pair
from backend.services.code_benchmark import FRAMES, CodeScene
from backend.stages.cloud import Cloud
from backend.stages.fringe_capture import fringe_frames
from backend.stages.fringe_phase import FringePhaseParams, fringe_phase
from backend.stages.fusion import FusionParams, fusion
from backend.stages.rig_geometry import (
    from_reference,
    pinhole,
    projector_from_reference,
    require_camera,
)
from backend.stages.stereo_cloud import StereoCloudParams, stereo_cloud

PERIODS = (59.0, 64.0, 70.0)
STEPS = 4
_MEAN_GRAY, _AMPLITUDE_GRAY, _NOISE_GRAY = 110.0, 60.0, 1.5
_PLANE_MM = 700.0
_CLEAR_PEAK = Path("/proc/self/clear_refs")
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class Timing:
    """How long one piece of work takes."""

    name: str
    best_ms: float
    over_copy: float
    """Over the time of copying the frames that it reads."""


@dataclass(frozen=True)
class BenchmarkReport:
    """Figures of this machine."""

    size: str
    rounds: int
    copy_ms: float
    """Copying 12 frames in memory."""
    timings: tuple[Timing, ...]
    chain_s: float
    """From the last frame in memory to the cloud with normals and sigma, two cameras."""
    points: int
    frames_mb: float
    peak_mb: float | None
    """Memory that the chain takes beside its frames; None where the system doesn't tell."""

    def document(self) -> dict[str, Any]:
        """Write the figures as JSON values."""
        return asdict(self)


def run_benchmark(
    size: str = "2560x1920", *, rounds: int = 5, progress: Progress | None = None
) -> BenchmarkReport:
    """Decode, match and triangulate a synthetic plane, and run the whole chain.

    Parameters
    ----------
    size
        Width and height of the cameras, e.g. `2560x1920`.
    rounds
        The best of so many counts.
    progress
        Is told what is being measured.

    Raises
    ------
    RigConfigError
        If the size can't be understood.
    """
    tell = progress or _silent
    tell(0.0, "frames")
    scene = _Scene(size)
    left = scene.pictures["left"]
    buffers = [np.empty_like(frame) for frame in left]

    def copy() -> None:
        for buffer, frame in zip(buffers, left, strict=True):
            np.copyto(buffer, frame)

    tell(0.3, "decode")
    copy_ms, decode_ms = best_ms(copy, scene.decode, rounds=rounds)
    tell(0.5, "match and triangulate")
    match_ms, triangulate_ms = best_ms(scene.match, scene.triangulate, rounds=rounds)
    tell(0.7, "whole chain")
    chain_ms = best_ms(scene.chain, rounds=max(2, rounds // 2))[0]
    peak_mb = _peak_mb(scene.chain)
    tell(0.9, "Gray code")
    code = CodeScene(*scene.size_px)
    code_copy_ms, code_ms = best_ms(code.copy, code.decode, rounds=rounds)
    return BenchmarkReport(
        size=size,
        rounds=rounds,
        copy_ms=copy_ms,
        timings=(
            Timing("decode 12 frames", decode_ms, decode_ms / copy_ms),
            Timing("match two cameras", match_ms, match_ms / copy_ms),
            Timing("triangulate", triangulate_ms, triangulate_ms / copy_ms),
            Timing(f"decode {FRAMES} frames of Gray code", code_ms, code_ms / code_copy_ms),
        ),
        chain_s=chain_ms / 1000.0,
        points=scene.chain().point_count,
        frames_mb=sum(f.nbytes for frames in scene.pictures.values() for f in frames) / 1e6,
        peak_mb=peak_mb,
    )


def best_ms(*works: Callable[[], object], rounds: int) -> list[float]:
    """Return the best time of each; they take turns, so that a busy moment meets all of them."""
    best = [float("inf")] * len(works)
    for work in works:
        work()
    for _ in range(rounds):
        for number, work in enumerate(works):
            began = time.perf_counter()
            work()
            best[number] = min(best[number], 1e3 * (time.perf_counter() - began))
    return best


def _silent(done: float, text: str = "") -> None:
    """Report to nobody."""


def _peak_mb(work: Callable[[], object]) -> float | None:
    """Return the resident memory at its highest during a run, above what it was before, in [MB]."""
    try:
        _give_back()
        _CLEAR_PEAK.write_text("5")
        before = _resident_mb("VmRSS")
        work()
        return _resident_mb("VmHWM") - before
    except OSError:
        return None


def _give_back() -> None:
    """Return freed memory to the system where the C library can: what is kept would hide a part of the peak."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _resident_mb(key: str) -> float:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return float(line.split()[1]) / 1000


class _Scene:
    """A plane before the simulated rig's devices, its pictures calculated without ray casting."""

    def __init__(self, size: str) -> None:
        rig = create_rig({"size": size})
        calibration = rig.calibration()
        assert calibration is not None, "the simulated rig is calibrated unless told otherwise"
        self.facts: RigFacts = rig.facts()
        self.calibration: RigCalibration = calibration
        assert self.facts.projector is not None, "the simulated rig has a projector"
        self.code = SineCode.equal_steps(PERIODS, STEPS)
        self.columns = {name: self._column_px(name) for name in self.facts.cameras}
        rng = np.random.default_rng(0)
        self.pictures = {n: self._frames(columns, rng) for n, columns in self.columns.items()}
        self._orders = maximum_likelihood(PERIODS)
        self._decoded = empty_maps(self.columns["left"].shape)
        self._matches = self.match()

    def _column_px(self, name: str) -> Float[np.ndarray, "h w"]:
        """Return the projector column that lights each pixel of a camera."""
        camera = pinhole(self.calibration.cameras[name])
        camera_from_reference = from_reference(
            self.calibration, self.calibration.camera_from_world[name]
        )
        width, height = camera.width_px, camera.height_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        slopes = rays(pixels.astype(np.float64), camera)
        directions = np.column_stack([slopes, np.ones(len(slopes))]) @ camera_from_reference.R
        origin = inverse(camera_from_reference).t_mm
        depth = (_PLANE_MM - origin[2]) / directions[:, 2]
        points = origin + directions * depth[:, None]
        return project(points, *self._projector)[:, 0].reshape(height, width)

    @cached_property
    def _projector(self) -> tuple[Pinhole, RigidTransform]:
        pose = projector_from_reference(self.calibration)
        assert pose is not None, "the simulated rig's calibration has its projector"
        assert self.calibration.projector is not None, (
            "the simulated rig's calibration has its projector"
        )
        return pinhole(self.calibration.projector), pose

    def _frames(
        self, columns_px: Float[np.ndarray, "h w"], rng: np.random.Generator
    ) -> list[UInt8[np.ndarray, "h w"]]:
        position = ((columns_px + 0.5) / self._projector[0].width_px).astype(np.float32)
        noise = rng.normal(_MEAN_GRAY, _NOISE_GRAY, columns_px.shape).astype(np.float32)
        frames = []
        for number, pattern in enumerate(_patterns()):
            phase = 2 * np.pi * pattern.periods * position + pattern.shift_rad
            gray = np.roll(noise, number, axis=1) + _AMPLITUDE_GRAY * np.cos(phase)
            frames.append(np.round(gray).astype(np.uint8))
        return frames

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the cameras."""
        height, width = self.pictures["left"][0].shape
        return width, height

    def decode(self) -> object:
        """Decode one camera's frames to column, modulation, residual and reasons."""
        return decode_frames(
            self.pictures["left"],
            self.code,
            self._orders,
            size_px=self._projector[0].width_px,
            saturation_gray=254,
            out=self._decoded,
        )

    @cached_property
    def _pair(self) -> Rectification:
        pose = from_reference(self.calibration, self.calibration.camera_from_world["right"])
        left, right = (require_camera(self.calibration, name) for name in ("left", "right"))
        return rectify(left, right, pose)

    @cached_property
    def _maps(self) -> dict[str, Any]:
        return {name: columns.astype(np.float32) for name, columns in self.columns.items()}

    def match(self) -> Matches:
        """Find the partners of all pixels."""
        return match(self._maps["left"], self._maps["right"], self._pair)

    def triangulate(self) -> object:
        """Make points of the partners."""
        return triangulate_pair(self._matches, self._pair)

    def chain(self) -> Cloud:
        """Run the stages from the frames to the cloud."""
        frames = tuple(
            Frame(name, pattern, 20.0, InMemory(picture), role="fringe")
            for name, pictures in self.pictures.items()
            for pattern, picture in zip(_patterns(), pictures, strict=True)
        )
        # Nobody holds the phasors once the phase is there, as in a scan, whose results are on disk by then.
        phase = fringe_phase(
            fusion(fringe_frames(frames), None, None, self.facts, FusionParams(), _silent),
            self.facts,
            FringePhaseParams(),
            _silent,
        )
        cloud: Cloud = stereo_cloud(phase, self.calibration, None, StereoCloudParams(), _silent)
        return cloud


def _patterns() -> list[Sine]:
    shifts = 2 * np.pi * np.arange(STEPS) / STEPS
    return [Sine(periods=p, shift_rad=float(shift)) for p in PERIODS for shift in shifts]
