"""From captured fringes to the place on the screen that every pixel sees in the mirror."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from backend.domain.arrays import ArrayHash, LoadArray
from backend.domain.checks import Check, at_least
from backend.domain.errors import InvalidSettingError, StageFailedError, sentence_of
from backend.domain.hints import Curve, Mask, Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.errors import NumericsError
from backend.numerics.fringe_health import BELONGS_PERCENT, MOST_PIXELS, RampVerdict
from backend.numerics.reasons import Reason
from backend.numerics.screen_phase import (
    ScreenPosition,
    phase_ripple_rad,
    screen_position,
)
from backend.numerics.screen_ramp import control_of_gray
from backend.numerics.sine_code import step_fit
from backend.numerics.surface_maps import against_surroundings, smoothed
from backend.stages.camera_noise import noise_model
from backend.stages.cloud import REASON_LABELS
from backend.stages.fringe_checks import (
    Chosen,
    FrameFinding,
    defective_frames,
    ramp_verdict,
    set_closures,
)
from backend.stages.linearise import Linear
from backend.stages.ramp import Ramp, monotone
from backend.stages.reflect_capture import ReflectFrames
from backend.stages.reflect_sets import AxisSets, FringeSteps, Step, axis_sets, mask_fields

Reading = Literal["linear", "ramp", "gray"]

DEFECT_RADIUS_SHARE = 0.02
"""Surroundings of a defect, as part of the picture's width."""
MOST_RIPPLES_PER_PX = 0.9
"""Once per pixel, a ripple looks like the mirror's shape."""
RIPPLE_WINDOW_PX = 200
"""Half the side of the square in which ripples are looked for."""
FIELD_SHARE = 0.15
"""Of the brightest change between dark and light field: where the screen changes less there is no mirror."""


class ScreenPhaseParams(Params):
    """How fringes are read and which pixels are accepted."""

    reading: Reading | None = setting(None, title="Gray levels as", auto="reading")
    """linear: through the chosen representation; ramp: through the inverse of the ramp on file; gray: as captured.
    Automatic: linear where there is a linearisation, else the ramp; gray where fringes are straighter that way."""
    modulation_min_gray: float = setting(3.0, title="Least modulation", unit="gray", ge=0, le=1000)
    """Amplitude of the finest fringes in captured gray levels."""
    residual_max_cycles: float = setting(
        0.25, title="Largest contradiction", unit="cycles", gt=0, le=0.5
    )
    """By how much a fringe may miss what the coarser fringes predict; at 0.5 every fringe order is accepted."""
    saturation_gray: float | None = setting(
        None, title="Saturated from", unit="gray", ge=1, le=65535, advanced=True
    )
    """Automatic: full scale. A few clipped gray levels bend the phase, so such pixels are left out."""
    mask: ArrayHash | None = setting(None, title="Mirror's pixels")
    """Painted or imported mask; none: where light and dark field differ, or everything."""
    leave_out: tuple[int, ...] | None = setting(
        None, title="Frames left out", auto="left_out", max_length=64
    )
    """Numbers of fringe frames, from 0 in the order of capture. Automatic: those found defective."""
    whole_mask: bool = setting(False, title="Keep the mask whole", advanced=True)
    """Keep pixels of the mask whose fringes are weak or contradict: for comparisons with other programs."""


@dataclass(frozen=True)
class FringeRow:
    """One set of fringes."""

    axis: str
    periods: float
    modulation_gray: float
    """Median over valid pixels."""
    closure: float
    """Rms departure from a sinusoid over the modulation; NaN for three steps."""
    ripple_mrad: float
    """Amplitude of the phase error that repeats once per step: what a response that isn't linear leaves. NaN for the
    finest fringes where a pixel takes in so much of one that its repetition can't be seen."""


@dataclass(frozen=True)
class ScreenPhase:
    """Where on the screen every pixel looks by way of the mirror."""

    share_x: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Position on the screen, x", unit="of the width", colormap="turbo"),
    ]
    """Position in the pattern, in [0, 1]; NaN where invalid. Empty if x wasn't coded."""
    share_y: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Position on the screen, y", unit="of the height", colormap="turbo"),
    ]
    finest_rad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Phase of the finest fringes", unit="rad", colormap="twilight"),
    ]
    """Along x (or y, where x wasn't coded), in (-pi, pi]."""
    modulation_gray: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Modulation", unit="gray", colormap="viridis"),
    ]
    defects: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Defects", unit="of the surroundings", colormap="gray", low=-0.3, high=0.3),
    ]
    """Modulation of the finest fringes against its surroundings: scratches, dust and finger prints scatter light."""
    residual_cycles: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Contradiction", unit="cycles", colormap="inferno", low=0.0),
    ]
    sigma_mrad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Predicted noise of the phase", unit="mrad", colormap="inferno", low=0.0),
    ]
    reasons: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]], Mask("Missing because", REASON_LABELS, bits=True)
    ]
    mirror: Annotated[
        Mapping[str, UInt16[np.ndarray, "_h _w"]],
        Mask("Mirror's pixels", {1: "mirror"}, edits="mask"),
    ]
    """1 where the mirror is."""
    sets: Annotated[tuple[FringeRow, ...], Table("Fringes")]
    findings: Annotated[tuple[FrameFinding, ...], Table("Defective frames")]
    response_gray: Annotated[
        Float[np.ndarray, "_point"],
        Curve("Gray level over the fringe", x="response_cosine", x_title="cosine", unit="gray"),
    ]
    """Learned from the fringes; empty where they don't tell."""
    response_cosine: Float[np.ndarray, "_point"]
    reading: Annotated[str, Value("Gray levels read as")]
    valid_share: Annotated[float, Value("Mirror's pixels with a position")]
    median_sigma_mrad: Annotated[float, Value("Predicted noise, median", unit="mrad")]
    ramp_error_percent: Annotated[float, Value("Departure from a sine by the ramp", unit="%")]
    """NaN without a ramp (or linearisation), or where it doesn't cover the fringes."""
    gray_error_percent: Annotated[float, Value("Departure from a sine as captured", unit="%")]
    ramp_belongs: bool | None
    """None: there is none, or the fringes don't tell."""
    left_out: tuple[int, ...]
    """Frames that weren't used."""
    wrapped_x_rad: Mapping[str, Float32[np.ndarray, "_k _h _w"]]
    """Phases of all period counts along x, the coarsest first."""
    wrapped_y_rad: Mapping[str, Float32[np.ndarray, "_k _h _w"]]
    periods_x: tuple[float, ...]
    periods_y: tuple[float, ...]


def _frames_whole(result: ScreenPhase, params: ScreenPhaseParams) -> Check:
    worst = max(result.findings, key=lambda f: f.closure, default=None)
    if worst is None:
        return Check("defective frames", Level.OK, "all frames fit their sets")
    which = "a frame" if worst.number is None else f"frame {worst.number}"
    done = (
        "left out"
        if worst.number in result.left_out
        else "still used: leave it out or capture again"
    )
    return Check(
        "defective frames", Level.WARNING,
        f"{which} of the {worst.periods:g} periods along {worst.axis} doesn't fit the others (closure {worst.closure:.3f}, "
        f"usual is {worst.usual:.3f}); it is {done}",
        worst.closure, 1.8 * worst.usual,
    )  # fmt: skip


def _ramp_belongs(result: ScreenPhase, params: ScreenPhaseParams) -> Check:
    if result.ramp_belongs is None:
        return Check("ramp", Level.OK, "no ramp to compare the fringes with")
    value, limit = result.ramp_error_percent, BELONGS_PERCENT
    if result.ramp_belongs:
        sentence = f"the ramp belongs to the fringes: they depart from a sine by {value:.1f} % read through it"
        return Check("ramp", Level.OK, sentence, value, limit, "%")
    seen = f"by {value:.1f} %" if np.isfinite(value) else "as it doesn't cover them"
    used = result.reading != "gray"
    remedy = "record the ramp anew" if used else "fringes are read as gray levels"
    sentence = (
        f"the ramp on file doesn't belong to these fringes: read through it they depart from a sine {seen}, "
        f"as captured by {result.gray_error_percent:.1f} %; {remedy}"
    )
    return Check("ramp", Level.FAILURE if used else Level.WARNING, sentence, value, limit, "%")


def _enough(result: ScreenPhase, params: ScreenPhaseParams) -> Check:
    return at_least(
        "valid share", result.valid_share, warning=0.8, failure=0.001,
        sentence=f"{result.valid_share:.1%} of the mirror's pixels know their place on the screen",
        remedy="look at why pixels are missing, then change exposure, periods or the mask",
    )  # fmt: skip


def _absolute(result: ScreenPhase, params: ScreenPhaseParams) -> Check:
    for axis, periods in (("x", result.periods_x), ("y", result.periods_y)):
        if not periods:
            return Check("axes", Level.WARNING, f"no fringes along {axis}: phase only, no slopes")
        if periods[0] > 1:
            return Check(
                "axes", Level.WARNING,
                f"the coarsest fringes along {axis} have {periods[0]:g} periods: phase only, add one of at most 1 period",
            )  # fmt: skip
    return Check("axes", Level.OK, "positions are absolute in x and y")


@stage(
    title="Screen phase", version=1, review=Review.ON_WARNING,
    checks=(_frames_whole, _ramp_belongs, _enough, _absolute),
)  # fmt: skip
def screen_phase(
    frames: ReflectFrames,
    linear: Linear | None,
    ramp: Ramp | None,
    facts: RigFacts,
    params: ScreenPhaseParams,
    load: LoadArray,
    progress: Progress,
) -> ScreenPhase:
    """Find the place on the screen that each pixel sees, from coarse to fine fringes."""
    sets = axis_sets(frames.frames)
    decoded: list[_Camera] = []
    cameras = list(dict.fromkeys(one.camera for one in sets))
    for number, camera in enumerate(cameras):
        progress(number / len(cameras), f"camera {camera}")
        of_camera = tuple(one for one in sets if one.camera == camera)
        try:
            decoded.append(_decode(camera, of_camera, frames, linear, ramp, facts, params, load))
        except NumericsError as error:
            raise StageFailedError(sentence_of(error)) from error
    return _summarise(decoded)


@dataclass(frozen=True)
class _Camera:
    """What one camera saw."""

    name: str
    sets: tuple[AxisSets, ...]
    positions: Mapping[str, ScreenPosition]
    """By axis."""
    mirror: Bool[np.ndarray, "h w"]
    reasons: UInt16[np.ndarray, "h w"]
    rows: tuple[FringeRow, ...]
    findings: tuple[FrameFinding, ...]
    read: "_Read"
    left_out: tuple[int, ...]
    sigma_mrad: Float32[np.ndarray, "h w"]

    @property
    def main(self) -> ScreenPosition:
        """The first axis that was coded."""
        return self.positions[self.sets[0].axis]

    @property
    def defects(self) -> Float32[np.ndarray, "h w"]:
        """Modulation against its surroundings; NaN off the mirror."""
        # Not over the mean: light that doesn't come from the screen is no defect.
        modulation = np.where(self.mirror, self.main.modulation_gray, np.float32(np.nan))
        radius_px = max(3.0, DEFECT_RADIUS_SHARE * modulation.shape[1])
        return against_surroundings(modulation, radius_px=radius_px)

    def periods(self, axis: str) -> tuple[float, ...]:
        """Period counts along an axis, none if it wasn't coded."""
        return next((one.periods for one in self.sets if one.axis == axis), ())


def _decode(
    camera: str,
    sets: tuple[AxisSets, ...],
    frames: ReflectFrames,
    linear: Linear | None,
    ramp: Ramp | None,
    facts: RigFacts,
    params: ScreenPhaseParams,
    load: LoadArray,
) -> _Camera:
    mirror = _mirror_mask(camera, sets, frames, params, load)
    if not mirror.any():
        raise StageFailedError(
            f"Camera {camera!r} sees no pixel of a mirror with the screen in it: move the mirror into view, check the "
            "light field, or paint the mask."
        )
    chosen = _telling_pixels(mirror, sets)
    read = _read(sets, chosen, linear, ramp, params)
    closure = set_closures(sets, chosen, read.values)
    findings = defective_frames(sets, closure, chosen, read.values)
    left_out = params.leave_out
    if left_out is None:
        left_out = tuple(f.number for f in findings if f.number is not None)
    used = tuple(one.without(frozenset(left_out)) for one in sets)
    if left_out:
        read = _read(used, chosen, linear, ramp, params)
    positions: dict[str, ScreenPosition] = {
        one.axis: screen_position([f.gray for f in one.frames], one.code, read.values)
        for one in used
    }
    reasons = _reasons(camera, used, positions, mirror, facts, params)
    valid = reasons == 0
    return _Camera(
        camera, used, positions, mirror, reasons, _rows(used, positions, valid, closure), findings,
        read, left_out, _sigma_mrad(camera, used[0], positions, facts),
    )  # fmt: skip


@dataclass(frozen=True)
class _Read:
    """How gray levels are read, and why."""

    values: Float[np.ndarray, "level"] | None
    reading: Reading
    verdict: RampVerdict | None
    """What the fringes say of the table at hand; None: there is none, or they don't tell."""


def _read(
    sets: tuple[AxisSets, ...],
    chosen: Chosen,
    linear: Linear | None,
    ramp: Ramp | None,
    params: ScreenPhaseParams,
) -> _Read:
    """Choose: as set, else through the table at hand unless the fringes are straighter without it."""
    table, kind = _table(linear, ramp, params)
    if table is None:
        return _Read(None, "gray", None)
    verdict = ramp_verdict(sets[0], chosen, table)
    use = kind == "linear"
    if params.reading is not None:
        use = params.reading != "gray"
    elif verdict is not None:
        use = verdict.belongs or verdict.table_error_percent < verdict.raw_error_percent
    return _Read(table if use else None, kind if use else "gray", verdict)


def _table(
    linear: Linear | None, ramp: Ramp | None, params: ScreenPhaseParams
) -> tuple[Float[np.ndarray, "level"] | None, Reading]:
    """Return the linear value of each gray level that is at hand, and where it comes from."""
    if linear is not None and params.reading != "ramp":
        return linear.values, "linear"
    if params.reading == "linear":
        raise InvalidSettingError(
            "There is no linearisation to read the fringes through: choose gray or the ramp."
        )
    if ramp is not None:
        return inverse_ramp(ramp), "ramp"
    if params.reading == "ramp":
        raise InvalidSettingError(
            "There is no ramp on file to read the fringes through: choose gray, or hand over a ramp."
        )
    return None, "gray"


def inverse_ramp(ramp: Ramp) -> Float[np.ndarray, "level"]:
    """Return the control value of each gray level, NaN beyond the ramp.

    Raises
    ------
    StageFailedError
        If the ramp isn't monotone.
    """
    return control_of_gray(monotone(ramp), int(ramp.full_scale_gray) + 1)


def _mirror_mask(
    camera: str,
    sets: tuple[AxisSets, ...],
    frames: ReflectFrames,
    params: ScreenPhaseParams,
    load: LoadArray,
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that see the mirror: painted, or where the screen's light arrives."""
    height, width = sets[0].frames[0].pixels.shape
    if params.mask is not None:
        mask = load(params.mask)
        if mask.shape != (height, width):
            raise InvalidSettingError(
                f"The mirror's mask is {mask.shape[-1]} x {mask.shape[0]} px but the camera's pictures are "
                f"{width} x {height}: make it from a picture of this camera."
            )
        return np.asarray(mask > 0)
    fields = mask_fields(frames.frames, camera)
    if fields is None:
        return np.ones((height, width), np.bool_)
    change = fields.light.gray.astype(np.float32) - fields.dark.gray
    bright = float(np.percentile(change, 99.5))
    return np.asarray(change > FIELD_SHARE * max(bright, 1.0))


def _telling_pixels(mirror: Bool[np.ndarray, "h w"], sets: tuple[AxisSets, ...]) -> Chosen:
    """Choose pixels that tell the frames' health: on the mirror, not saturated, with fringes."""
    frames = sets[0].sets[0].equal
    lowest = np.minimum.reduce([s.frame.gray for s in frames]).astype(np.float32)
    highest = np.maximum.reduce([s.frame.gray for s in frames])
    swing = highest - lowest
    full = frames[0].frame.full_scale_gray
    chosen = mirror & (highest < full)
    if not chosen.any():
        chosen = mirror
    places = np.flatnonzero(chosen & (swing >= 0.5 * np.median(swing[chosen])))
    return places[:: 1 + places.size // MOST_PIXELS].astype(np.int64)


def _reasons(
    camera: str,
    sets: tuple[AxisSets, ...],
    positions: Mapping[str, ScreenPosition],
    mirror: Bool[np.ndarray, "h w"],
    facts: RigFacts,
    params: ScreenPhaseParams,
) -> UInt16[np.ndarray, "h w"]:
    """Say of every pixel why it has no position."""
    reasons = np.zeros(mirror.shape, np.uint16)
    full = sets[0].frames[0].full_scale_gray
    saturated_from = params.saturation_gray or full
    for one in sets:
        found = positions[one.axis]
        bright = found.brightest_gray >= saturated_from
        reasons[bright] |= np.uint16(Reason.SATURATED)
        untrusted = ~np.isfinite(found.share) & ~bright
        reasons[untrusted] |= np.uint16(Reason.DARK)
        if params.whole_mask:
            continue
        weak = found.modulation_gray < params.modulation_min_gray
        reasons[weak] |= np.uint16(Reason.LOW_MODULATION)
        if one.periods[0] <= 1:
            contradicts = found.residual_cycles > params.residual_max_cycles
            reasons[contradicts] |= np.uint16(Reason.ORDER_RESIDUAL)
            outside = (found.share < 0) | (found.share > 1)
            reasons[outside] |= np.uint16(Reason.OUTSIDE_PROJECTOR)
    reasons[~mirror] = np.uint16(Reason.MISSING_DATA)
    return reasons


def _rows(
    sets: tuple[AxisSets, ...],
    positions: Mapping[str, ScreenPosition],
    valid: Bool[np.ndarray, "h w"],
    closure: Mapping[tuple[str, float], float],
) -> tuple[FringeRow, ...]:
    rows = []
    for one in sets:
        found = positions[one.axis]
        share = np.where(valid, found.share, np.float32(np.nan))
        window = _window(valid)
        for place, of_one in enumerate(one.sets):
            finest = place == len(one.sets) - 1
            ripple = float("nan")
            if one.periods[0] <= 1:
                smooth = _without_fringes(share[window], of_one) if finest else share[window]
                ripple = phase_ripple_rad(
                    found.wrapped_rad[place][window],
                    smooth,
                    periods=of_one.periods,
                    harmonic=len(of_one.equal),
                )
            modulation = _modulation_gray(of_one.equal, valid)
            rows.append(
                FringeRow(
                    one.axis,
                    of_one.periods,
                    modulation,
                    closure[one.axis, of_one.periods],
                    1e3 * ripple,
                )
            )
    return tuple(rows)


def _window(valid: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Return the middle of the valid pixels' extent: enough to see a ripple."""
    parts = []
    for axis in (0, 1):
        places = np.flatnonzero(valid.any(axis=1 - axis))
        middle = int(places.mean()) if places.size else 0
        parts.append(slice(max(0, middle - RIPPLE_WINDOW_PX), middle + RIPPLE_WINDOW_PX))
    return parts[0], parts[1]


def _without_fringes(
    share: Float32[np.ndarray, "h w"], finest: FringeSteps
) -> Float32[np.ndarray, "h w"]:
    """Smooth positions over about a fringe, so that its ripple is gone; NaN where pixels are too coarse for that."""
    steps = [np.abs(np.diff(share, axis=axis)) for axis in (0, 1)]
    known = [float(np.median(s[np.isfinite(s)])) for s in steps if np.isfinite(s).any()]
    cycles_per_px = finest.periods * max(known, default=0.0)
    if not 0.0 < cycles_per_px * len(finest.equal) <= MOST_RIPPLES_PER_PX:
        return np.full(share.shape, np.nan, np.float32)
    sigma_px = float(np.clip(1.0 / cycles_per_px, 2.0, 15.0))
    return smoothed(share, sigma_px=sigma_px).astype(np.float32)


def _modulation_gray(steps: tuple[Step, ...], valid: Bool[np.ndarray, "h w"]) -> float:
    """Return the median amplitude of one set in captured gray levels."""
    places = np.flatnonzero(valid)
    places = places[:: 1 + places.size // MOST_PIXELS]
    if places.size == 0:
        return float("nan")
    gray = np.stack([s.frame.gray.ravel()[places] for s in steps]).astype(np.float64)
    weights = step_fit([s.shift_rad for s in steps]).weights[:2]
    return float(np.median(np.hypot(*(weights @ gray))))


def _sigma_mrad(
    camera: str,
    one: AxisSets,
    positions: Mapping[str, ScreenPosition],
    facts: RigFacts,
) -> Float32[np.ndarray, "h w"]:
    """Predict the noise of the finest phase from the camera's and the fringes' modulation."""
    noise = noise_model(facts.cameras[camera], gain_db=one.frames[0].gain_db)
    found = positions[one.axis]
    gain = np.float32(1e3 * np.sqrt(one.code.noise_gains[-1]))
    sigma_gray = noise.sigma_gray(found.mean_gray).astype(np.float32)
    return np.asarray(gain * sigma_gray / np.maximum(found.modulation_gray, np.float32(1e-3)))


def _summarise(cameras: list[_Camera]) -> ScreenPhase:
    first = cameras[0]
    nan = np.float32(np.nan)
    valid = {c.name: c.reasons == 0 for c in cameras}
    share: dict[str, dict[str, Float32[np.ndarray, "h w"]]] = {"x": {}, "y": {}}
    wrapped: dict[str, dict[str, Float32[np.ndarray, "k h w"]]] = {"x": {}, "y": {}}
    for c in cameras:
        for axis, position in c.positions.items():
            wrapped[axis][c.name] = position.wrapped_rad
            if first.periods(axis)[0] <= 1:
                share[axis][c.name] = np.where(valid[c.name], position.share, nan)
    mirror = sum(int(c.mirror.sum()) for c in cameras)
    sigma = {c.name: np.where(valid[c.name], c.sigma_mrad, nan) for c in cameras}
    known = np.concatenate([s[np.isfinite(s)] for s in sigma.values()])
    return ScreenPhase(
        share_x=share["x"],
        share_y=share["y"],
        finest_rad={c.name: np.where(valid[c.name], c.main.wrapped_rad[-1], nan) for c in cameras},
        modulation_gray={c.name: c.main.modulation_gray for c in cameras},
        defects={c.name: c.defects for c in cameras},
        residual_cycles={
            c.name: np.maximum.reduce([p.residual_cycles for p in c.positions.values()])
            for c in cameras
        },
        sigma_mrad=sigma,
        reasons={c.name: c.reasons for c in cameras},
        mirror={c.name: c.mirror.astype(np.uint16) for c in cameras},
        sets=tuple(row for c in cameras for row in c.rows),
        findings=tuple(f for c in cameras for f in c.findings),
        response_gray=np.zeros(0)
        if first.read.verdict is None
        else first.read.verdict.learned.gray,
        response_cosine=np.zeros(0)
        if first.read.verdict is None
        else first.read.verdict.learned.cosine,
        reading=first.read.reading,
        valid_share=sum(int(v.sum()) for v in valid.values()) / max(mirror, 1),
        median_sigma_mrad=float(np.median(known)) if known.size else float("nan"),
        ramp_error_percent=float("nan")
        if first.read.verdict is None
        else first.read.verdict.table_error_percent,
        gray_error_percent=float("nan")
        if first.read.verdict is None
        else first.read.verdict.raw_error_percent,
        ramp_belongs=None if first.read.verdict is None else first.read.verdict.belongs,
        left_out=first.left_out,
        wrapped_x_rad=wrapped["x"],
        wrapped_y_rad=wrapped["y"],
        periods_x=first.periods("x"),
        periods_y=first.periods("y"),
    )
