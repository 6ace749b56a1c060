"""Export what a method projects as pictures, for projectors that play from memory; and test patterns.

Which patterns a method shows is found out by making scans: two short ones, of different simulated scenes, with the very
code that captures. What both show doesn't depend on what the cameras saw, and can be written down beforehand.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import singledispatch
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter

from backend.contract.requests import CreateScan, Decide, StartRun
from backend.contract.scans import ScanState, StageState
from backend.devices.loading import options_schema, rig_for
from backend.devices.pattern_set import (
    FORMAT,
    INDEX_FILE,
    NewPattern,
    PatternSet,
    pattern_hash,
    write_picture,
    write_set,
)
from backend.domain.errors import ConflictError, InvalidSettingError, UnglareError
from backend.domain.patterns import (
    BLACK,
    WHITE,
    Gray,
    Pattern,
    Sine,
    StaticPicture,
    Stripe,
    Uniform,
)
from backend.domain.states import StageStatus, Verdict
from backend.jobs.rendering import render
from backend.numerics.errors import PatternError
from backend.numerics.test_patterns import TEST_PATTERNS, test_pattern
from backend.services.export_folder import FolderKind, refuse_foreign, whole_folder
from backend.services.services import Services

PATTERNS = FolderKind(INDEX_FILE, FORMAT)
WHO = "patterns export"

_CAMERA_SIZE = "160x120"
"""Of the trials' cameras: their pictures matter only in being different."""
_MOST_GATES = 50
_READ: TypeAdapter[Pattern] = TypeAdapter(Pattern)

Pack = Literal["none", "24bit"]


@dataclass(frozen=True)
class Wanted:
    """What is to be exported."""

    method: str
    width_px: int
    height_px: int
    preset: str | None = None
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    gamma: float = 1.0
    """Of the projector."""
    levels: tuple[int, ...] = ()
    """Even fields that are wanted besides black and white."""
    test_patterns: bool = False
    """Whether the test patterns are wanted, too."""


@dataclass(frozen=True)
class _Shown:
    """What one stage of one trial showed."""

    free: tuple[str, ...]
    """Patterns as JSON, in the order in which they were shown first."""
    masked: int
    """How many were dimmed by a mask."""


@dataclass(frozen=True)
class Trial:
    """What a method showed before one scene."""

    stages: Mapping[str, _Shown]
    titles: Mapping[str, str]
    unreached: Mapping[str, str]
    """Capturing stages that weren't run, and why."""


def record_trials(services: Services, wanted: Wanted) -> tuple[Trial, Trial]:
    """Make a scan of two simulated scenes and note what is projected.

    Parameters
    ----------
    services
        Of a data folder that may be thrown away.
    wanted
        Method, settings and the projector's size.

    Raises
    ------
    UnglareError
        If there is no such method or setting, or the projector's size can't be used.
    """
    rig = rig_for(None, wanted.method)
    first, second = (_trial(services, wanted, rig, options) for options in _scenes(rig, wanted))
    return first, second


def _scenes(rig: str, wanted: Wanted) -> Iterator[dict[str, Any]]:
    properties = options_schema(rig)["properties"]
    known = properties["scene"]
    other = next(name for name in known["examples"] if name != known["default"])
    options: dict[str, Any] = {
        "size": _CAMERA_SIZE,
        "projector_size": f"{wanted.width_px}x{wanted.height_px}",
    }
    if "gamma" in properties:
        options["gamma"] = wanted.gamma
    for scene in (known["default"], other):
        yield {**options, "scene": scene}


def _trial(services: Services, wanted: Wanted, rig: str, options: dict[str, Any]) -> Trial:
    state = services.create_scan(
        CreateScan(
            method=wanted.method,
            rig=rig,
            rig_options=options,
            preset=wanted.preset,
            settings={stage: dict(values) for stage, values in wanted.settings.items()},
        ),
        WHO,
    )
    method = services.context.registry.get(wanted.method)
    capturing = [stage.name for stage in method.stages if stage.captures]
    if capturing:
        state, reason = _run_through(
            services, state.id, StartRun(until=capturing[-1], unattended=True)
        )
    else:
        reason = ""
    with services.context.database.reading() as repositories:
        rows = repositories.frames.of_scan(state.id)
    shots: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        shots.setdefault(row.stage, []).append(row.document)
    return Trial(
        stages={stage: _shown(documents) for stage, documents in shots.items()},
        titles={stage.name: stage.title for stage in method.stages},
        unreached={
            s.name: reason or s.message
            for s in state.stages
            if s.name in capturing and _is_unreached(s)
        },
    )


def _run_through(services: Services, scan: str, request: StartRun) -> tuple[ScanState, str]:
    """Run a scan on and on; a result that fails its check is accepted: only what is shown counts here."""
    try:
        services.run(scan, request, WHO)
        for _ in range(_MOST_GATES):
            state = services.wait(scan)
            gate = next((s for s in state.stages if s.status is StageStatus.AWAITING_REVIEW), None)
            if gate is None or gate.stage_run is None:
                return state, (state.job.error or "") if state.job else ""
            services.decide(gate.stage_run, Decide(verdict=Verdict.ACCEPT, proceed=False), WHO)
            services.run(scan, request, WHO)
    except UnglareError as error:
        return services.scan(scan), error.sentence
    return services.scan(scan), ""


def _is_unreached(stage: StageState) -> bool:
    return stage.status in (StageStatus.UNAVAILABLE, StageStatus.PENDING, StageStatus.FAILED)


def _shown(documents: Sequence[Mapping[str, Any]]) -> _Shown:
    patterns = [_READ.validate_python(document["pattern"]) for document in documents]
    shown = zip(patterns, documents, strict=True)
    free, masked = [], set()
    for pattern, document in shown:
        text = pattern.model_dump_json()
        if document["mask"] is None:
            free.append(text)
        else:
            masked.add((text, document["mask"]))
    return _Shown(tuple(dict.fromkeys(free)), len(masked))


# ---------------------------------------------------------------- what can be written


def pictures_of(
    trials: tuple[Trial, Trial], wanted: Wanted
) -> tuple[tuple[NewPattern, ...], tuple[str, ...]]:
    """Return the pictures that can be written, and a sentence for each stage that shows others."""
    first, second = trials
    stages: dict[str, list[str]] = {}
    left_out = []
    for name, shown in first.stages.items():
        title, again = first.titles[name], second.stages.get(name)
        fixed = [p for p in shown.free if again is None or p in again.free]
        for pattern in fixed:
            stages.setdefault(pattern, []).append(name)
        if shown.masked:
            left_out.append(
                f"{title} ({name}): {_patterns(shown.masked)} can't be exported, as a mask that is made of the scan's"
                " own frames dims them."
            )
        if len(fixed) < len(shown.free):
            left_out.append(
                f"{title} ({name}): {_patterns(len(shown.free) - len(fixed))} can't be exported, as the scan's own"
                " frames decide on them."
            )
    left_out += [
        f"{first.titles[name]} ({name}) wasn't reached in the trial, what it shows is missing: {reason}"
        for name, reason in first.unreached.items()
    ]
    patterns = [(_READ.validate_json(text), tuple(names)) for text, names in stages.items()]
    evens = [WHITE, BLACK, *(Uniform(gray=level) for level in wanted.levels)]
    pictures = _merged([*patterns, *((even, ()) for even in evens)], wanted)
    return (*pictures, *_test_pictures(pictures, wanted)), tuple(left_out)


def _test_pictures(known: Sequence[NewPattern], wanted: Wanted) -> Iterator[NewPattern]:
    """Draw the test patterns as the rig desk shows them, but those that are there already."""
    hashes = {pattern_hash(new.picture) for new in known}
    for kind in TEST_PATTERNS if wanted.test_patterns else ():
        picture = test_pattern(kind, wanted.width_px, wanted.height_px)
        if pattern_hash(picture) not in hashes:
            yield NewPattern(picture, f"test pattern {kind}")


def _merged(
    patterns: Sequence[tuple[Pattern, tuple[str, ...]]], wanted: Wanted
) -> tuple[NewPattern, ...]:
    """Render patterns as a capture does; those that look the same are one."""
    merged: dict[str, NewPattern] = {}
    for pattern, stages in patterns:
        picture = render(
            pattern, width_px=wanted.width_px, height_px=wanted.height_px, gamma=wanted.gamma
        )
        key = pattern_hash(picture)
        if key in merged:
            known = merged[key]
            merged[key] = NewPattern(
                known.picture,
                known.what,
                known.pattern,
                tuple(dict.fromkeys((*known.stages, *stages))),
            )
        else:
            merged[key] = NewPattern(
                picture, describe(pattern), pattern.model_dump(mode="json"), stages
            )
    return tuple(merged.values())


def export_patterns(
    patterns: Sequence[NewPattern],
    left_out: Sequence[str],
    wanted: Wanted,
    folder: Path,
    pack: Pack,
) -> PatternSet:
    """Write a set into a folder that appears whole or not at all.

    Raises
    ------
    ConflictError
        If something else is in the folder, or it can't be written.
    """
    with whole_folder(folder, PATTERNS) as place:
        return write_set(
            place.root,
            patterns,
            method=wanted.method,
            gamma=wanted.gamma,
            pack=pack == "24bit",
            left_out=left_out,
        )


def refuse_folder(folder: Path) -> None:
    """Refuse a folder that a set couldn't go to, before the trials are made.

    Raises
    ------
    ConflictError
        If anything but an older set is there.
    """
    refuse_foreign(folder.expanduser().absolute(), PATTERNS)


def export_test_pattern(
    kind: str,
    width_px: int,
    height_px: int,
    path: Path,
    *,
    label: str = "projector",
    cell_px: int | None = None,
) -> None:
    """Write one test pattern as PNG or BMP.

    Raises
    ------
    InvalidSettingError
        If there is no such pattern, its size can't be drawn, or the file's name says another format.
    ConflictError
        If the file can't be written.
    """
    if path.suffix.lower() not in (".png", ".bmp"):
        raise InvalidSettingError(f"{path} is no name of a picture: let it end in .png or .bmp.")
    try:
        picture = test_pattern(kind, width_px, height_px, label=label, cell_px=cell_px)
        write_picture(path.expanduser(), picture)
    except PatternError as error:
        sentence = str(error)
        raise InvalidSettingError(f"{sentence[0].upper()}{sentence[1:]}.") from error
    except OSError as error:
        raise ConflictError(
            f"{path} can't be written ({error.strerror}): name another file."
        ) from error


# ---------------------------------------------------------------- words


@singledispatch
def describe(pattern: object) -> str:
    """Say what a pattern is."""
    return type(pattern).__name__


@describe.register
def _sine(pattern: Sine) -> str:
    shift_deg = np.rad2deg(pattern.shift_rad + pattern.offset_rad) % 360
    return (
        f"fringes, {_along(pattern.axis)}, {pattern.periods:g} periods, shifted by {shift_deg:.4g}°"
    )


@describe.register
def _gray(pattern: Gray) -> str:
    inverse = ", inverse" if pattern.inverse else ""
    return f"Gray code, {_along(pattern.axis)}, bit {pattern.bit} of {pattern.bits}{inverse}"


@describe.register
def _stripe(pattern: Stripe) -> str:
    inverse = ", inverse" if pattern.inverse else ""
    shift = f"shifted by {pattern.shift_periods:.4g} periods"
    return f"stripes, {_along(pattern.axis)}, {pattern.periods:g} periods, {shift}{inverse}"


@describe.register
def _uniform(pattern: Uniform) -> str:
    return f"even field, gray {pattern.gray:g}"


@describe.register
def _nothing(pattern: StaticPicture) -> str:
    return "nothing"


def _patterns(count: int) -> str:
    return "1 pattern" if count == 1 else f"{count} patterns"


def _along(axis: str) -> str:
    return "from column to column" if axis == "x" else "from row to row"
