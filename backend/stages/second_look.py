"""A second look at pixels that get light from two places at once: a few epipolar lines are lit at a time."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float32, Int32, Shaped, UInt8

from backend.domain.checks import Check
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames, Mask, Picture, Value
from backend.domain.params import setting
from backend.domain.patterns import WHITE, Gray, Pattern, Stripe
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.shots import Burst, Exposed, OneOf, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.code_certainty import PairGeometry, on_epipolar_line
from backend.numerics.epipolar_bands import EpipolarLines, epipolar_lines
from backend.numerics.errors import CalibrationError
from backend.numerics.intensity_mask import evened, light_at, scatter, widen_dark
from backend.numerics.second_look import Looks, possible_places, second_light
from backend.numerics.triangulation import projector_consistency, triangulate_projector
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_frames import CodeFrames, code_frames
from backend.stages.code_map import least_contrast_gray, require_projector
from backend.stages.edges import Codes, EdgesParams, edges
from backend.stages.intensity_mask import IntensityMask
from backend.stages.pre_exposure import ExposureGrid
from backend.stages.rig_geometry import camera_geometry

_DEPTH_MARGIN_MM = 15.0
_SURE = 0.005
"""Share of the told pixels at either end of their depths that is left out of the range."""
_MARGIN_PX = 2.0
"""By which lit bands are wider than the lines that they are for."""
_TARGET = 0.85
"""Share of the full scale that the second look may bring a pixel to."""
_MOST_RAISE = np.float32(6.0)
_SMOOTHING_PX = 3.0
_BESIDES_S = 0.1
"""What a picture takes besides its exposure: until a display has drawn and settled, and a frame has come."""
_UNTOLD, _SECOND_LIGHT, _TOLD_NOW = 1, 2, 3
LABELS = {
    _UNTOLD: "no code that agrees with the calibration, or none at all",
    _SECOND_LIGHT: "much of its light comes from other places",
    _TOLD_NOW: "told by the second look",
}


class SecondLookParams(EdgesParams):
    """When a second look is taken, and how."""

    run: Literal["auto", "yes", "no"] = setting("auto", title="Second look")
    """Auto: under a refined mask, if more of the lit pixels than allowed get light from two places."""
    few: float = setting(0.002, title="Such pixels allowed", ge=0, le=1)
    """Share of the lit pixels that may stay untold, or lit from two places, without a second look."""
    second_light: float = setting(0.06, title="Light from other places", ge=0.01, le=1)
    """Share of its light from which a pixel is looked at again: it moves stripe edges."""
    epipolar_px: float = setting(2.5, title="Row against epipolar line", unit="px", gt=0, le=1000)
    """A code that misses its epipolar line by more came by a second reflection."""
    bands: int = setting(32, title="Looks", ge=2, le=64)
    """Each lights one of so many bands of epipolar lines, and takes a picture of every column pattern. The
    gaps between a look's bands grow with their number."""
    band_px: float = setting(3.0, title="Width of a band", unit="px", ge=2, le=200)
    """In projector pixels. Narrow bands part places that are near each other, as in a corner."""
    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", gt=0, auto="exposure_ms", advanced=True
    )
    """Automatic: as long as half of the pixels looked at need for the brightness that is aimed at, with the
    projector at its brightest for them."""
    budget_s: float = setting(600.0, title="Time budget", unit="s", gt=0, le=36_000)
    """Of all looks, each picture with 0.1 s besides its exposure: where that doesn't suffice, those looks are taken
    that most pixels wait for."""


@dataclass(frozen=True)
class SecondLook:
    """The columns' code once more, on a few epipolar lines at a time."""

    marked: Annotated[
        Mapping[str, UInt8[np.ndarray, "_h _w"]], Mask("Light from two places", LABELS)
    ]
    second_light: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Light from other places", low=0.0, high=1.0, colormap="inferno"),
    ]
    """Share of each pixel's light that doesn't come along its own epipolar lines; NaN where a second camera doesn't
    know which those are."""
    before_share: Annotated[float, Value("Lit pixels untold or lit from two places")]
    after_share: Annotated[float, Value("After the second look")]
    looks: Annotated[int, Value("Looks taken")] = 0
    codes: Codes | None = None
    """What the second look tells, where it was taken; None: it wasn't."""
    trusted: Mapping[str, Bool[np.ndarray, "_h _w"]] = field(default_factory=dict)
    """Pixels whose second code is to be used."""
    frames: Annotated[tuple[Frame, ...], Frames("Code of the second look")] = ()
    exposure_ms: Annotated[float, Value("Exposure of the looks", unit="ms")] = float("nan")
    left_out: Annotated[int, Value("Looks left out for want of time")] = 0
    whole_s: Annotated[float, Value("Expected time of all looks", unit="s")] = float("nan")
    """Expected, those left out included."""


def _told(result: SecondLook, params: SecondLookParams) -> Check:
    if np.isnan(result.before_share):
        return Check("told", Level.OK, "nobody looked which pixels are lit from two places")
    sentence = f"{result.before_share:.2%} of the lit pixels are untold or lit from two places"
    if result.codes is not None:
        sentence += f", {result.after_share:.2%} after a second look"
    if not result.left_out:
        return Check("told", Level.OK, sentence, result.after_share, params.few)
    sentence += (
        f"; {result.left_out} of {result.left_out + result.looks} looks were left out: all of them take about"
        f" {result.whole_s:.0f} s, the time budget is {params.budget_s:g} s, raise it or open the aperture"
    )
    return Check("told", Level.WARNING, sentence, result.after_share, params.few)


@stage(title="Second look", version=2, review=Review.ON_WARNING, checks=(_told,))
def second_look(
    codes: Codes,
    frames: CodeFrames,
    mask: IntensityMask | None,
    base: BaseExposure,
    facts: RigFacts,
    calibration: RigCalibration | None,
    params: SecondLookParams,
    shoot: Shoot,
) -> SecondLook:
    """Show the code once more only where nobody looked: second reflections from bright places can't outshine it."""
    if not _allowed(mask, params) or mask is None:
        return _NOTHING
    try:
        look = _Look(codes, frames, mask, base, facts, calibration, params)
    except CalibrationError:
        # Camera and projector above each other: their lines run along the columns, and bands can't part places.
        return _NOTHING
    return shoot(look.plan()) if look.possible else _NOTHING


_NOTHING = SecondLook({}, {}, float("nan"), float("nan"))


def _allowed(mask: IntensityMask | None, params: SecondLookParams) -> bool:
    if params.run == "auto":
        return mask is not None and mask.round > 0
    return params.run == "yes"


class _Look:
    """Everything that the plan of a second look needs: it is taken with the reference camera.

    Other cameras only see the white fields: which of their pixels get light from two places.
    """

    def __init__(
        self,
        codes: Codes,
        frames: CodeFrames,
        mask: IntensityMask,
        base: BaseExposure,
        facts: RigFacts,
        calibration: RigCalibration | None,
        params: SecondLookParams,
    ) -> None:
        self.name = facts.reference
        self.codes, self.mask, self.base, self.facts = codes, mask, base, facts
        self.params = params
        self.projector = require_projector(facts)
        pairs = camera_geometry(calibration, _coded(codes, facts, calibration))
        pair = pairs.get(self.name)
        self.patterns = _column_patterns(frames)
        self.possible = pair is not None and bool(self.patterns)
        if pair is None or not self.possible:
            return
        self.pair: PairGeometry = pair
        self.lines: EpipolarLines = epipolar_lines(*pair)
        self.looks = Looks(params.band_px, params.bands)
        self.line_px = {name: self._lines_of(name, pairs[name]) for name in pairs}
        self.own: Int32[np.ndarray, "h w"] = self.looks.own(self.lines.camera_px)
        self.told = (codes.reasons[self.name] == 0) & on_epipolar_line(
            codes.projector_px[self.name],
            codes.projector_row_px[self.name],
            pair,
            tolerance_px=params.epipolar_px,
        )

    def _lines_of(self, name: str, pair: PairGeometry) -> Float32[np.ndarray, "_h _w"]:
        """Return which of the reference camera's lines lights each pixel: another camera knows by its code alone."""
        if name == self.name:
            return self.lines.camera_px
        columns = self.codes.projector_px[name]
        points_mm = triangulate_projector(columns, *pair).points_mm
        return light_at(self.lines.projector_px, columns, _rows(points_mm, pair))

    def plan(self) -> Plan[SecondLook]:
        """See who gets light from elsewhere, then code the lines of those, some at a time."""
        whites = yield self._whites()
        alone = self._alone(self.name, whites)
        second = {n: self._second_light(n, whites[0], self._alone(n, whites)) for n in self.line_px}
        lit = self.base.lit[self.name]
        wanted = lit & (~self.told | (second[self.name] > self.params.second_light))
        if int(np.count_nonzero(wanted)) <= self.params.few * max(1, int(np.count_nonzero(lit))):
            return self._result(second, wanted)
        picture = _Composite(self.name, self.patterns, self.own)
        depths_mm = self._depths_mm()
        raised, exposure_ms = self._exposed(self._raised(alone, wanted), wanted)
        numbers = self._numbers(wanted)
        chosen = self._within_budget(numbers, exposure_ms)
        for place, number in enumerate(chosen):
            pixels = wanted & (self.own == number)
            factor = self._factor(number, raised, pixels, depths_mm)
            if not factor.any():
                continue
            burst = tuple(
                self._shot(pattern, factor, exposure_ms, (self.name,)) for pattern in self.patterns
            )
            exposed = yield OneOf(burst, place, len(chosen), "look")
            picture.take_in(exposed, number)
        left_out = len(numbers) - len(chosen)
        whole_s = len(numbers) * self._look_s(exposure_ms)
        if not picture.frames:
            result = self._result(second, wanted)
        else:
            codes = edges(picture.code(), IntensityMask(raised), self.facts, self.params, _silent)
            told = self._told_now(codes, wanted & np.isin(self.own, chosen), depths_mm)
            result = self._result(second, wanted, told, picture, exposure_ms)
        return replace(result, left_out=left_out, whole_s=whole_s)

    def _numbers(self, wanted: Bool[np.ndarray, "h w"]) -> list[int]:
        """Return the looks that pixels wait for, those that most wait for first."""
        waiting = np.bincount(self.own[wanted], minlength=self.params.bands)
        order = np.argsort(-waiting, kind="stable")
        return [int(number) for number in order if waiting[number]]

    def _look_s(self, exposure_ms: float) -> float:
        return len(self.patterns) * (exposure_ms / 1000.0 + _BESIDES_S)

    def _within_budget(self, numbers: list[int], exposure_ms: float) -> list[int]:
        """Return those looks that there is time for, in the order in which they are taken."""
        return sorted(numbers[: int(self.params.budget_s / self._look_s(exposure_ms))])

    # what is captured

    def _shot(
        self,
        pattern: Pattern,
        factor: Float32[np.ndarray, "h w"],
        exposure_ms: float,
        cameras: tuple[str, ...],
    ) -> Shot:
        return Shot(
            pattern,
            exposure_ms,
            self.base.gain_db,
            cameras,
            role="second look",
            mask=InMemory(factor),
        )

    def _whites(self) -> Burst:
        """Return the white field under the mask: all of it, then each look's lines."""
        factor = np.asarray(self.mask.factor, np.float32)
        parts = [
            np.where(self.looks.lit(self.lines.projector_px, n, _MARGIN_PX), factor, np.float32(0))
            for n in range(self.params.bands)
        ]
        cameras = tuple(self.line_px)
        return tuple(
            self._shot(WHITE, part, self.base.exposure_ms, cameras) for part in (factor, *parts)
        )

    def _alone(self, name: str, whites: tuple[Exposed, ...]) -> Float32[np.ndarray, "h w"]:
        """Return every pixel under the look that lights its own lines; NaN where those aren't known."""
        line_px = self.line_px[name]
        own = self.looks.own(line_px)
        alone = np.full(own.shape, np.nan, np.float32)
        for number, shot in enumerate(whites[1:]):
            np.copyto(alone, shot[name].gray, where=own == number, casting="unsafe")
        return np.where(np.isnan(line_px), np.float32(np.nan), alone)

    def _second_light(
        self, name: str, white: Exposed, alone: Float32[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w"]:
        noise_gray = least_contrast_gray(self.facts.cameras[name])
        black = self.base.black[name].astype(np.float32)
        share = second_light(
            white[name].gray.astype(np.float32), alone, black, noise_gray=noise_gray
        )
        return np.where(np.isnan(alone), np.float32(np.nan), share)

    def _exposed(
        self, raised: Float32[np.ndarray, "hp wp"], wanted: Bool[np.ndarray, "h w"]
    ) -> tuple[Float32[np.ndarray, "hp wp"], float]:
        """Take a shorter exposure and more light instead, where most of the pixels looked at are dimmed anyway."""
        base_ms = self.base.exposure_ms
        exposure_ms = self.params.exposure_ms
        columns, rows = (
            m.get(self.name) for m in (self.mask.projector_px, self.mask.projector_row_px)
        )
        if exposure_ms is None and columns is not None and rows is not None:
            given = light_at(raised, columns, rows)[wanted]
            known = given[np.isfinite(given)]
            share = float(np.median(known)) if known.size else 1.0
            grid = ExposureGrid.of(self.facts, snap=True)
            exposure_ms = min(base_ms, grid.ms(grid.index(share * base_ms)))
        exposure_ms = exposure_ms or base_ms
        brighter = raised * np.float32(base_ms / exposure_ms)
        return np.asarray(np.clip(brighter, 0, 1), np.float32), exposure_ms

    def _raised(
        self, alone: Float32[np.ndarray, "h w"], wanted: Bool[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "hp wp"]:
        """Give back to the pixels looked at the light that the mask took because of second reflections."""
        factor = np.asarray(self.mask.factor, np.float32)
        columns, rows = (
            m.get(self.name) for m in (self.mask.projector_px, self.mask.projector_row_px)
        )
        if columns is None or rows is None:
            return factor
        camera = self.facts.cameras[self.name]
        black = self.base.black[self.name].astype(np.float32)
        room = np.float32(_TARGET * camera.full_scale_gray) - black
        signal = np.maximum(alone - black, np.float32(least_contrast_gray(camera)))
        given = light_at(factor, columns, rows)
        share = np.where(wanted, given * room / signal, np.float32(np.nan))
        most = np.full(factor.shape, np.inf, np.float32)
        scatter(share, columns, rows, into=most)
        known = np.where(np.isinf(most), np.minimum(_MOST_RAISE * factor, 1), most).astype(
            np.float32
        )
        # Smooth, as edges move where the light changes within the projector's blur; widened before, so that
        # smoothing dazzles nobody.
        even = evened(widen_dark(known, _SMOOTHING_PX), _SMOOTHING_PX)
        return np.asarray(np.clip(even, 0, np.minimum(_MOST_RAISE * factor, 1)), np.float32)

    def _depths_mm(self) -> tuple[float, float]:
        """Return between which depths surfaces are: those of the pixels told, and a little more."""
        points_mm = triangulate_projector(self.codes.projector_px[self.name], *self.pair).points_mm
        depth_mm = points_mm[self.told, 2]
        if not depth_mm.size:
            return 0.0, 0.0
        near, far = np.quantile(depth_mm[:: max(1, depth_mm.size // 100_000)], [_SURE, 1 - _SURE])
        return max(1.0, float(near) - _DEPTH_MARGIN_MM), float(far) + _DEPTH_MARGIN_MM

    def _factor(
        self,
        number: int,
        raised: Float32[np.ndarray, "hp wp"],
        pixels: Bool[np.ndarray, "h w"],
        depths_mm: tuple[float, float],
    ) -> Float32[np.ndarray, "hp wp"]:
        """Light a look's lines, but only as far as its pixels may look: less light, fewer reflections."""
        near_mm, far_mm = depths_mm
        lit = self.looks.lit(self.lines.projector_px, number, _MARGIN_PX)
        if not pixels.any() or near_mm >= far_mm:
            return np.zeros(lit.shape, np.float32)
        places = possible_places(pixels, self.pair, near_mm=near_mm, far_mm=far_mm)
        return np.where(lit & places, raised, np.float32(0))

    # what is told

    def _told_now(
        self, codes: Codes, pixels: Bool[np.ndarray, "h w"], depths_mm: tuple[float, float]
    ) -> "_Told":
        columns = codes.projector_px[self.name]
        points_mm = triangulate_projector(columns, *self.pair).points_mm
        with np.errstate(invalid="ignore"):
            inside = (points_mm[..., 2] >= depths_mm[0]) & (points_mm[..., 2] <= depths_mm[1])
        rows = _rows(points_mm, self.pair)
        codes = replace(codes, projector_row_px={self.name: rows})
        return _Told(codes, pixels & (codes.reasons[self.name] == 0) & inside)

    def _result(
        self,
        second: Mapping[str, Float32[np.ndarray, "_h _w"]],
        wanted: Bool[np.ndarray, "h w"],
        told: "_Told | None" = None,
        picture: "_Composite | None" = None,
        exposure_ms: float = float("nan"),
    ) -> SecondLook:
        told_now = np.zeros(wanted.shape, bool) if told is None else told.use
        marked = np.zeros(wanted.shape, np.uint8)
        marked[wanted] = _UNTOLD
        marked[wanted & self.told] = _SECOND_LIGHT
        marked[told_now] = _TOLD_NOW
        others = {n: self._marked(n, share) for n, share in second.items() if n != self.name}
        lit = max(1, int(np.count_nonzero(self.base.lit[self.name])))
        return SecondLook(
            {self.name: marked, **others},
            second,
            int(np.count_nonzero(wanted)) / lit,
            int(np.count_nonzero(wanted & ~told_now)) / lit,
            picture.looks if picture else 0,
            told.codes if told else None,
            {self.name: told_now} if told else {},
            tuple(picture.frames) if picture else (),
            exposure_ms,
        )

    def _marked(self, name: str, share: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        """Mark the pixels of a camera that takes no second look."""
        with np.errstate(invalid="ignore"):
            is_second = self.base.lit[name] & (share > np.float32(self.params.second_light))
        return np.where(is_second, np.uint8(_SECOND_LIGHT), np.uint8(0))


@dataclass(frozen=True)
class _Told:
    """What the looks tell together, and about which pixels."""

    codes: Codes
    use: Bool[np.ndarray, "h w"]


class _Composite:
    """One picture of each pattern, put together from the looks: every pixel as it is when its own lines are lit."""

    def __init__(
        self, name: str, patterns: tuple[Pattern, ...], own: Int32[np.ndarray, "h w"]
    ) -> None:
        self.name, self.patterns, self.own = name, patterns, own
        self.frames: list[Frame] = []
        """As they were captured."""
        self.looks = 0
        self.grays: list[Shaped[np.ndarray, "h w"]] = []

    def take_in(self, exposed: tuple[Exposed, ...], number: int) -> None:
        """Take the pixels of a look."""
        taken = [shot[self.name] for shot in exposed]
        if not self.looks:
            self.grays = [np.zeros_like(frame.gray) for frame in taken]
        for gray, frame in zip(self.grays, taken, strict=True):
            np.copyto(gray, frame.gray, where=self.own == number)
        self.frames += taken
        self.looks += 1

    def code(self) -> CodeFrames:
        """Return the pictures as if they had been captured so."""
        first = self.frames[: len(self.patterns)]
        return code_frames(
            tuple(
                replace(frame, pixels=InMemory(gray))
                for frame, gray in zip(first, self.grays, strict=True)
            )
        )


def _rows(
    points_mm: Float32[np.ndarray, "h w 3"], pair: PairGeometry
) -> Float32[np.ndarray, "h w"]:
    """Return the projector row of each point, finer than a code of rows tells it."""
    none = np.zeros(points_mm.shape[:2], np.float32)
    # The residual against row 0 is the row.
    return projector_consistency(
        points_mm, none, pair.projector, pair.projector_from_camera, rows=True
    )


def _coded(codes: Codes, facts: RigFacts, calibration: RigCalibration | None) -> tuple[str, ...]:
    """Name the cameras that read columns and rows, if the reference camera is one of them."""
    if calibration is None:
        return ()
    names = [n for n in codes.projector_px if n in codes.projector_row_px and n in facts.cameras]
    known = tuple(n for n in names if n in calibration.camera_from_world)
    return known if facts.reference in known else ()


def _column_patterns(frames: CodeFrames) -> tuple[Pattern, ...]:
    """Return the first look's patterns of columns, in their order."""
    first = frames.frames[0].camera
    return tuple(
        f.pattern
        for f in frames.frames
        if f.camera == first and isinstance(f.pattern, Gray | Stripe) and f.pattern.axis == "x"
    )


def _silent(done: float, text: str = "") -> None:
    """Report to nobody: the shots have told how far the stage is."""
