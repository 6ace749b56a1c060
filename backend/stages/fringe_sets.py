"""Sort captured fringes into sets: per camera and direction, frequencies with the same steps at each exposure."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.patterns import Axis, Gray, Sine

_SAME_SHIFT_RAD = 1e-4


@dataclass(frozen=True)
class Exposed:
    """The frames of one exposure."""

    exposure_ms: float | None
    sines: tuple[Frame, ...]
    """Frequency by frequency, within a frequency step by step."""
    grays: tuple[Frame, ...]
    """Gray code, highest bit first, a bit's inverse behind it; empty without."""


@dataclass(frozen=True)
class FringeSet:
    """All fringes of one camera along one direction."""

    camera: str
    axis: Axis
    periods: tuple[float, ...]
    shifts_rad: tuple[tuple[float, ...], ...]
    """Offset + shift of each step, one tuple per frequency."""
    exposures: tuple[Exposed, ...]
    """Shortest first."""
    bit_depth: int
    gain_db: float

    @property
    def exposures_ms(self) -> tuple[float, ...]:
        """Exposure of each set of frames; a capture that doesn't tell counts as 1 ms."""
        return tuple(e.exposure_ms if e.exposure_ms is not None else 1.0 for e in self.exposures)

    def subset(self, steps: int, first: int = 0) -> "FringeSet":
        """Use every n-th step, e.g. steps 0, 3, 6, 9 of twelve as a four-step set."""
        counts = {len(s) for s in self.shifts_rad}
        total = max(counts)
        if len(counts) > 1 or steps < 3 or total % steps:
            raise InvalidCaptureError(
                f"{steps} steps can't be taken out of sets of {sorted(counts)}: choose a divisor that is 3 or more."
            )
        keep = range(first % (total // steps), total, total // steps)
        exposures = tuple(
            Exposed(
                e.exposure_ms,
                tuple(e.sines[f * total + k] for f in range(len(self.periods)) for k in keep),
                e.grays,
            )
            for e in self.exposures
        )
        shifts = tuple(tuple(s[k] for k in keep) for s in self.shifts_rad)
        return FringeSet(
            self.camera, self.axis, self.periods, shifts, exposures, self.bit_depth, self.gain_db
        )


def fringe_sets(frames: Iterable[Frame]) -> tuple[FringeSet, ...]:
    """Sort frames into sets and refuse what is incomplete.

    Raises
    ------
    InvalidCaptureError
        If there are no fringes, a step is missing at an exposure or a frequency, or bit depths,
        gains or sizes of one camera's frames differ.
    """
    groups: dict[tuple[str, Axis], list[Frame]] = defaultdict(list)
    for frame in frames:
        if isinstance(frame.pattern, Sine | Gray):
            groups[frame.camera, frame.pattern.axis].append(frame)
    sets = tuple(
        _one_set(camera, axis, group)
        for (camera, axis), group in groups.items()
        if any(isinstance(f.pattern, Sine) for f in group)
    )
    if not sets:
        raise InvalidCaptureError("The capture holds no fringes: frames of kind 'sine' are needed.")
    return sets


def _one_set(camera: str, axis: Axis, group: Sequence[Frame]) -> FringeSet:
    where = f"camera {camera!r}, axis {axis}"
    _same("bit depths", {f.bit_depth for f in group}, where)
    _same("gains", {f.gain_db for f in group}, where)
    _same("sizes", {f.pixels.shape for f in group}, where)
    by_exposure: dict[float | None, list[Frame]] = defaultdict(list)
    for frame in group:
        by_exposure[frame.exposure_ms].append(frame)
    ordered = sorted(by_exposure.items(), key=lambda item: item[0] or 0.0)
    exposed = [_exposed(exposure_ms, members) for exposure_ms, members in ordered]
    layouts = [_layout(e.sines) for e in exposed]
    reference = max(layouts, key=lambda layout: sum(len(s) for s in layout.values()))
    for e, layout in zip(exposed, layouts, strict=True):
        _compare(layout, reference, f"{where}, exposure {e.exposure_ms} ms")
    return FringeSet(
        camera=camera,
        axis=axis,
        periods=tuple(reference),
        shifts_rad=tuple(tuple(s) for s in reference.values()),
        exposures=tuple(exposed),
        bit_depth=group[0].bit_depth,
        gain_db=group[0].gain_db,
    )


def _same(what: str, values: set[object], where: str) -> None:
    if len(values) > 1:
        raise InvalidCaptureError(
            f"The frames of {where} have different {what}: {sorted(map(str, values))}; capture them alike."
        )


def _exposed(exposure_ms: float | None, frames: Sequence[Frame]) -> Exposed:
    sines = [f for f in frames if isinstance(f.pattern, Sine)]
    grays = [f for f in frames if isinstance(f.pattern, Gray)]
    order = {p: i for i, p in enumerate(dict.fromkeys(_sine(f).periods for f in sines))}
    sines.sort(key=lambda f: (order[_sine(f).periods], abs(_sine(f).shift_rad)))
    grays.sort(key=lambda f: (-_gray(f).bit, _gray(f).inverse))
    return Exposed(exposure_ms, tuple(sines), tuple(grays))


def _layout(sines: Sequence[Frame]) -> dict[float, list[float]]:
    layout: dict[float, list[float]] = defaultdict(list)
    for frame in sines:
        pattern = _sine(frame)
        layout[pattern.periods].append(pattern.offset_rad + pattern.shift_rad)
    return dict(layout)


def _compare(
    layout: dict[float, list[float]], reference: dict[float, list[float]], where: str
) -> None:
    alike = all(_same_shifts(layout.get(p, []), next(iter(reference.values()))) for p in reference)
    for periods, expected in reference.items():
        shifts = layout.get(periods, [])
        if not _same_shifts(shifts, expected) or not (alike or _evenly_spread(shifts)):
            most = max(len(s) for s in reference.values())
            found = ", ".join(f"{np.rad2deg(s):.0f}" for s in shifts) or "none"
            raise InvalidCaptureError(
                f"The step set of {where}, {periods:g} periods is incomplete: shifts {found} degrees where "
                f"others have {most} steps; add the missing frames or leave the frequency out."
            )


def _same_shifts(a: Sequence[float], b: Sequence[float]) -> bool:
    return len(a) == len(b) and np.allclose(a, b, atol=_SAME_SHIFT_RAD)


def _evenly_spread(shifts_rad: Sequence[float]) -> bool:
    turns = np.sort(np.mod(np.asarray(shifts_rad) / (2 * np.pi) + 1e-6, 1.0))
    gaps = np.diff(np.append(turns, turns[:1] + 1.0))
    return len(turns) >= 3 and np.allclose(gaps, 1.0 / len(turns), atol=1e-4)


def _sine(frame: Frame) -> Sine:
    assert isinstance(frame.pattern, Sine)
    return frame.pattern


def _gray(frame: Frame) -> Gray:
    assert isinstance(frame.pattern, Gray)
    return frame.pattern
