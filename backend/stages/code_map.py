"""Gray code to pixel accuracy, under a mask and at several exposures: where each camera pixel looks in the projector."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, Pixels
from backend.domain.patterns import Axis, Gray, gray_code
from backend.domain.rig import CameraFacts, ProjectorFacts, RigFacts
from backend.domain.shots import Plan, Shot
from backend.numerics.code_certainty import (
    PairGeometry,
    agreeing,
    fill_runs,
    on_epipolar_line,
    second_contrast,
)
from backend.numerics.edges import decode_bridged_gray_code
from backend.numerics.gray_code import decode_gray_code
from backend.numerics.reasons import Reason
from backend.stages.camera_noise import noise_model
from backend.stages.pre_exposure import ExposureGrid

_UNJUDGED_BITS = 1
"""The finest bit may be lost in the optics' blur: that costs a pixel, not the place."""
_AGREE_PX = 3.0
_EPIPOLAR_PX = 2.0
_LONGEST_RUN_PX = 40


@dataclass(frozen=True)
class CodeMap:
    """Where a camera's pixels look in the projector; NaN where unknown."""

    projector_px: Float32[np.ndarray, "h w"]
    projector_row_px: Float32[np.ndarray, "h w"]

    @property
    def known(self) -> Bool[np.ndarray, "h w"]:
        """Pixels with a place."""
        return np.asarray(~np.isnan(self.projector_px) & ~np.isnan(self.projector_row_px))


@dataclass(frozen=True)
class CodeShots:
    """How a code is captured."""

    exposures_ms: tuple[float, ...]
    """Longest first; what saturates is read from the next."""
    gain_db: float = 0.0
    cameras: tuple[str, ...] | None = None
    mask: Pixels | None = None
    min_contrast_gray: float | None = None
    """None: what noise allows."""
    lit: Mapping[str, Bool[np.ndarray, "_h _w"]] = field(default_factory=dict)
    """Pixels whose place is guessed from their neighbours where it can't be read; empty: none is."""
    geometry: Mapping[str, PairGeometry] = field(default_factory=dict)
    """Camera against projector, where it is known: light that came by a second reflection is told by it."""


def code_patterns(projector: ProjectorFacts) -> tuple[Gray, ...]:
    """List the Gray code of columns, then of rows, with one stripe per projector pixel."""
    return tuple(p for axis, size in _sizes(projector).items() for p in gray_code(axis, size))


def code_map_plan(facts: RigFacts, how: CodeShots) -> Plan[Mapping[str, CodeMap]]:
    """Capture the code at every exposure and decode it; frames are let go of one exposure after the other."""
    projector = require_projector(facts)
    reads: dict[str, list[_Read]] = {}
    for number, exposure_ms in enumerate(how.exposures_ms):
        exposed = yield tuple(
            Shot(pattern, exposure_ms, how.gain_db, how.cameras, role="code", mask=how.mask)
            for pattern in code_patterns(projector)
        )
        bridge = number == len(how.exposures_ms) - 1
        for name in exposed[0]:
            frames = [shot[name] for shot in exposed]
            read = _read(frames, projector, facts.cameras[name], how, bridge=bridge)
            reads.setdefault(name, []).append(read)
    return {
        name: _combine(
            found,
            how.lit.get(name, np.zeros(found[0].saturated.shape, bool)),
            how.geometry.get(name),
        )
        for name, found in reads.items()
    }


def require_projector(facts: RigFacts) -> ProjectorFacts:
    """Return the projector's facts, or say that there is none."""
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: there is nothing to project a mask with.")
    return facts.projector


def shorter_ms(exposure_ms: float, times: float, facts: RigFacts) -> float:
    """Return an exposure that is so many times shorter, in whole projector frames and within the cameras' range."""
    grid = ExposureGrid.of(facts, snap=True)
    return min(exposure_ms, grid.ms(grid.index(exposure_ms / times)))


def least_contrast_gray(camera: CameraFacts) -> float:
    """Return the difference of two dark pictures that noise alone doesn't reach: five standard deviations."""
    return float(5 * np.sqrt(2 * noise_model(camera).dark_variance_gray2))


@dataclass(frozen=True)
class _Read:
    """What one exposure tells."""

    map: CodeMap
    saturated: Bool[np.ndarray, "h w"]


def _read(
    frames: Sequence[Frame],
    projector: ProjectorFacts,
    camera: CameraFacts,
    how: CodeShots,
    *,
    bridge: bool,
) -> _Read:
    contrast = how.min_contrast_gray or least_contrast_gray(camera)
    axes = [
        _read_axis(frames, axis, size, contrast, camera, bridge=bridge)
        for axis, size in _sizes(projector).items()
    ]
    known = np.logical_and.reduce([a.known for a in axes])
    columns, rows = (np.where(known, a.position_px, np.float32(np.nan)) for a in axes)
    return _Read(CodeMap(columns, rows), axes[0].saturated | axes[1].saturated)


@dataclass(frozen=True)
class _Axis:
    """What one exposure tells along one direction."""

    position_px: Float32[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]
    saturated: Bool[np.ndarray, "h w"]


def _read_axis(
    frames: Sequence[Frame],
    axis: Axis,
    size_px: int,
    contrast_gray: float,
    camera: CameraFacts,
    *,
    bridge: bool,
) -> _Axis:
    own = [f for f in frames if isinstance(f.pattern, Gray) and f.pattern.axis == axis]
    patterns, inverses = ([f.gray for f in own[start::2]] for start in (0, 1))
    full = camera.full_scale_gray - 1
    code = decode_gray_code(
        patterns,
        inverses,
        codes=size_px,
        size_px=size_px,
        min_contrast_gray=-1.0,  # nothing is unknown: the second weakest bit decides, see below
        saturation_gray=full,
    )
    judged = max(1, len(patterns) - _UNJUDGED_BITS)
    certain = second_contrast(patterns[:judged], inverses[:judged]) > contrast_gray
    saturated = (code.reasons & np.uint16(Reason.SATURATED)) != 0
    known = (code.reasons == 0) & certain
    position_px = code.projector_px
    if bridge and saturated.any():
        bridged = decode_bridged_gray_code(
            patterns,
            inverses,
            codes=size_px,
            size_px=size_px,
            min_contrast_gray=contrast_gray,
            saturation_gray=full,
            axis=axis,
        )
        take = saturated & bridged.extrapolated & (bridged.gray.reasons == 0)
        position_px = np.where(take, bridged.gray.projector_px, position_px)
        known = known | take
    return _Axis(position_px, known, saturated)


def _sizes(projector: ProjectorFacts) -> dict[Axis, int]:
    return {"x": projector.width_px, "y": projector.height_px}


def _combine(
    reads: Sequence[_Read], lit: Bool[np.ndarray, "h w"], geometry: PairGeometry | None
) -> CodeMap:
    """Take each pixel from the longest exposure that tells, drop what can't be, bridge what is missing."""
    columns, rows = reads[0].map.projector_px, reads[0].map.projector_row_px
    for read in reads[1:]:
        missing = np.isnan(columns)
        columns = np.where(missing, read.map.projector_px, columns)
        rows = np.where(missing, read.map.projector_row_px, rows)
    wrong = ~agreeing(columns, rows, tolerance_px=_AGREE_PX)
    if geometry is not None:
        wrong |= ~on_epipolar_line(columns, rows, geometry, tolerance_px=_EPIPOLAR_PX)
    nan = np.float32(np.nan)
    columns, rows = np.where(wrong, nan, columns), np.where(wrong, nan, rows)
    return CodeMap(*(_filled(m, lit) for m in (columns, rows)))


def _filled(
    position_px: Float32[np.ndarray, "h w"], lit: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Bridge gaps along rows, then what is left along columns."""
    along = fill_runs(position_px, lit, longest_px=_LONGEST_RUN_PX)
    return fill_runs(along.T, lit.T, longest_px=_LONGEST_RUN_PX).T
