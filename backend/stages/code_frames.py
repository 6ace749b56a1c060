"""Captured code, Gray code and shifted stripes: sorted into sets, and how imported frames become it."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.hints import Frames, Value
from backend.domain.patterns import Axis, Gray, Stripe, Uniform
from backend.numerics.line_shift import LEAST_SHIFTS, Stripes

_SAME_SHIFT_PERIODS = 1e-4
_SAME_EDGE_PX = 1e-3


@dataclass(frozen=True)
class CodeFrames:
    """The captured code of all cameras, columns and rows."""

    frames: Annotated[tuple[Frame, ...], Frames("Captured code")]
    frame_count: Annotated[int, Value("Frames")]
    exposure_time_s: Annotated[float, Value("Exposure time in all", unit="s")] = 0.0
    """Light time of one camera's frames; 0 where a folder doesn't tell."""


@dataclass(frozen=True)
class StripeSet:
    """Stripes at all their positions over half a period."""

    periods: float
    """Over the projector's width (or height)."""
    first_shift_periods: float
    patterns: tuple[Frame, ...]
    inverses: tuple[Frame, ...]

    def stripes(self, size_px: int) -> Stripes:
        """Return where the edges are on a projector of this size.

        Raises
        ------
        InvalidCaptureError
            If edges lie within projector pixels instead of between them.
        """
        shifts = len(self.patterns)
        period_px = size_px / self.periods
        found = Stripes(self.first_shift_periods * period_px, period_px / (2 * shifts), shifts)
        places = (found.first_edge_px, found.step_px)
        if any(abs(place - round(place)) > _SAME_EDGE_PX for place in places):
            raise InvalidCaptureError(
                f"Stripes with a period of {period_px:g} px at {shifts} positions have edges within pixels of a "
                f"projector of {size_px} px: choose a period whose half is a whole number of steps of whole pixels."
            )
        return Stripes(float(round(places[0])), float(round(places[1])), shifts)


@dataclass(frozen=True)
class CodeSet:
    """The Gray code of one camera along one direction."""

    camera: str
    axis: Axis
    codes: int
    """Stripes of the finest bit over the projector."""
    patterns: tuple[Frame, ...]
    """Coarsest bit first, all of them."""
    inverses: tuple[Frame, ...]
    """The same bits; empty where white and black tell the threshold."""
    white: Frame | None
    black: Frame | None
    stripes: StripeSet | None = None
    """Shifted stripes, which tell the place within a stripe of the Gray code."""

    @property
    def full_scale_gray(self) -> float:
        """The largest gray level."""
        return self.patterns[0].full_scale_gray


def import_code_frames(frames: tuple[Frame, ...]) -> CodeFrames:
    """Make the result of imported frames; refuses incomplete codes, passes over other patterns."""
    code_sets(frames)
    return code_frames(frames)


def code_frames(frames: tuple[Frame, ...]) -> CodeFrames:
    """Describe captured (or imported) code."""
    cameras = max(1, len({f.camera for f in frames}))
    light_ms = sum(f.exposure_ms or 0.0 for f in frames) / cameras
    return CodeFrames(frames, len(frames), light_ms / 1000.0)


def code_sets(frames: Iterable[Frame]) -> tuple[CodeSet, ...]:
    """Sort frames into the codes they make up, camera by camera, columns before rows.

    Raises
    ------
    InvalidCaptureError
        If there is no Gray code, a bit is missing or there twice, neither inverses nor a white and a black
        field are complete, stripes lack a position or an inverse or stand without a Gray code, or frames of one
        set differ in size, bit depth or number of codes.
    """
    stripes: dict[tuple[str, Axis], list[Frame]] = defaultdict(list)
    groups: dict[tuple[str, Axis], list[Frame]] = defaultdict(list)
    fields: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        if isinstance(frame.pattern, Gray):
            groups[frame.camera, frame.pattern.axis].append(frame)
        elif isinstance(frame.pattern, Stripe):
            stripes[frame.camera, frame.pattern.axis].append(frame)
        elif isinstance(frame.pattern, Uniform):
            fields[frame.camera].append(frame)
    if not groups:
        raise InvalidCaptureError(
            "The capture holds no Gray code: frames of kind 'gray' are needed."
        )
    if alone := sorted(set(stripes) - set(groups)):
        raise InvalidCaptureError(
            f"The stripes of camera {alone[0][0]!r}, axis {alone[0][1]} have no Gray code beside them, so nobody "
            "knows which stripe is which: add its frames."
        )
    return tuple(
        _code_set(camera, axis, groups[camera, axis], fields[camera], stripes[camera, axis])
        for camera, axis in sorted(groups)
    )


def _code_set(
    camera: str,
    axis: Axis,
    group: Sequence[Frame],
    fields: Sequence[Frame],
    stripes: Sequence[Frame],
) -> CodeSet:
    where = f"camera {camera!r}, axis {axis}"
    _alike("numbers of codes", {_gray(f).codes for f in group}, where)
    _alike("numbers of bits", {_gray(f).bits for f in group}, where)
    _alike("bit depths", {f.bit_depth for f in (*group, *stripes)}, where)
    _alike("sizes", {f.pixels.shape for f in (*group, *stripes)}, where)
    bits = _gray(group[0]).bits
    inverses = [f for f in group if _gray(f).inverse]
    white = max(fields, key=_field_gray, default=None)
    black = min(fields, key=_field_gray, default=None)
    has_fields = white is not None and black is not None and _field_gray(white) > _field_gray(black)
    if not inverses and not has_fields:
        raise InvalidCaptureError(
            f"The Gray code of {where} has neither inverse patterns nor a white and a black field: add one of them."
        )
    return CodeSet(
        camera=camera,
        axis=axis,
        codes=_gray(group[0]).codes,
        patterns=_complete([f for f in group if not _gray(f).inverse], bits, "patterns", where),
        inverses=_complete(inverses, bits, "inverse patterns", where) if inverses else (),
        white=white if has_fields else None,
        black=black if has_fields else None,
        stripes=_stripe_set(stripes, where) if stripes else None,
    )


def _stripe_set(frames: Sequence[Frame], where: str) -> StripeSet:
    """Sort stripes by position; half a period further on they are their own inverses."""
    _alike("periods of the stripes", {_stripe(f).periods for f in frames}, where)
    patterns: dict[float, Frame] = {}
    inverses: dict[float, Frame] = {}
    for frame in frames:
        shift, inverse = _position(_stripe(frame))
        group = inverses if inverse else patterns
        if shift in group:
            raise InvalidCaptureError(
                f"The stripes of {where} hold the shift of {shift:g} periods more than once: leave one frame of each."
            )
        group[shift] = frame
    if unpaired := sorted(set(patterns) ^ set(inverses)):
        raise InvalidCaptureError(
            f"The stripes of {where} have no inverse (or only that) at a shift of {unpaired[0]:g} periods: "
            "capture each position with its inverse."
        )
    shifts = sorted(patterns)
    _evenly_spread(shifts, where)
    return StripeSet(
        _stripe(frames[0]).periods,
        shifts[0],
        tuple(patterns[shift] for shift in shifts),
        tuple(inverses[shift] for shift in shifts),
    )


def _position(stripe: Stripe) -> tuple[float, bool]:
    """Return the shift within half a period, and whether the stripes are the inverse there."""
    half_turns = round(2 * stripe.shift_periods, 5)
    whole = int(half_turns // 1)
    return round((half_turns - whole) / 2, 6), stripe.inverse != (whole % 2 == 1)


def _evenly_spread(shifts_periods: Sequence[float], where: str) -> None:
    count = len(shifts_periods)
    step = 0.5 / count
    expected = [shifts_periods[0] + number * step for number in range(count)]
    fits = all(
        abs(a - b) < _SAME_SHIFT_PERIODS for a, b in zip(shifts_periods, expected, strict=True)
    )
    if count < LEAST_SHIFTS or shifts_periods[0] > step + _SAME_SHIFT_PERIODS or not fits:
        found = ", ".join(f"{shift:g}" for shift in shifts_periods)
        raise InvalidCaptureError(
            f"The stripes of {where} stand at {found} periods, which doesn't cover half a period in at least "
            f"{LEAST_SHIFTS} equal steps: add the missing positions."
        )


def _complete(frames: Sequence[Frame], bits: int, what: str, where: str) -> tuple[Frame, ...]:
    found = [_gray(f).bit for f in frames]
    if missing := sorted(set(range(bits)) - set(found)):
        raise InvalidCaptureError(
            f"The {what} of {where} lack bits {missing} of {bits}: add their frames."
        )
    if twice := sorted({bit for bit in found if found.count(bit) > 1}):
        raise InvalidCaptureError(
            f"The {what} of {where} hold bits {twice} more than once: leave one frame of each."
        )
    return tuple(sorted(frames, key=lambda f: -_gray(f).bit))


def _alike(what: str, values: set[object], where: str) -> None:
    if len(values) > 1:
        raise InvalidCaptureError(
            f"The Gray code frames of {where} have different {what}: {sorted(map(str, values))}; capture them alike."
        )


def _gray(frame: Frame) -> Gray:
    assert isinstance(frame.pattern, Gray), "only Gray code frames are sorted here"
    return frame.pattern


def _stripe(frame: Frame) -> Stripe:
    assert isinstance(frame.pattern, Stripe), "only stripes are sorted here"
    return frame.pattern


def _field_gray(frame: Frame) -> float:
    assert isinstance(frame.pattern, Uniform), "only uniform fields are compared here"
    return frame.pattern.gray
