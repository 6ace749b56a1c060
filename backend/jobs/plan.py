"""What of a scan is current and what has to run: keys, inputs, gates. Pure, nothing is stored.

`plan_scan` walks a method's stages in order. As an input enters a key by its content hash, the key of a stage
is known only when every input's result is; so a plan ends at the first stage that has to run, and is made anew
after each one. A recomputation with equal numbers gives equal hashes, hence old keys, hence old results.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

from backend.domain.errors import StageUnavailableError
from backend.domain.hashing import stage_key
from backend.domain.method import Method, Wire
from backend.domain.params import without_cosmetics
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.stage import Stage
from backend.domain.states import Level, Review, Verdict
from backend.domain.type_names import words
from backend.jobs.edits import resolve_settings
from backend.jobs.stage_settings import StageSettings
from backend.storage.rows import DecisionRow, GivenRow, RunRow

__all__ = [
    "Gate",
    "History",
    "PlannedStage",
    "Run",
    "ScanPlan",
    "capture_id",
    "gate_holds",
    "next_step",
    "plan_scan",
    "resolve_settings",
    "run_level",
]

RIG = "the rig"
"""What a stage waits for while the rig's facts aren't stored yet."""

_OF_RIG = (RigFacts, RigCalibration)


@dataclass(frozen=True)
class History:
    """What a scan's runs and decisions say of a key; all within the scan."""

    finished: Callable[[str], RunRow | None]
    """The finished run with a key."""
    decided: Callable[[str], DecisionRow | None]
    """The last decision on a key."""


@dataclass(frozen=True)
class PlannedStage:
    """Where one stage stands."""

    stage: Stage
    settings: StageSettings
    take: int
    """0 for a stage that doesn't capture."""
    key: str | None = None
    """Today's key; None while an input isn't known."""
    inputs: Mapping[str, GivenRow | RunRow | None] = field(default_factory=dict)
    """What each input is read from, complete when there is a key."""
    given: GivenRow | None = None
    run: RunRow | None = None
    """The finished run with today's key."""
    decision: DecisionRow | None = None
    missing: str | None = None
    """`needs X`, and why nothing supplies it: the stage is unavailable."""
    waits_for: str | None = None
    """The stage (or the rig) whose result has to be known first."""

    @property
    def name(self) -> str:
        """The stage's name in its method."""
        return self.stage.name

    @property
    def result(self) -> GivenRow | RunRow | None:
        """The present result, given or computed."""
        return self.given or self.run


@dataclass(frozen=True)
class ScanPlan:
    """Where every stage of a scan stands, in the method's order."""

    scan: str
    stages: tuple[PlannedStage, ...]

    def stage(self, name: str) -> PlannedStage:
        """Return one stage; KeyError if there is none of that name."""
        for planned in self.stages:
            if planned.name == name:
                return planned
        raise KeyError(name)


@dataclass(frozen=True)
class Run:
    """The next step: run this stage."""

    planned: PlannedStage


@dataclass(frozen=True)
class Gate:
    """The next step: none before the operator decides about this stage's result."""

    planned: PlannedStage
    level: Level


def plan_scan(
    scan: str,
    method: Method,
    *,
    settings: Mapping[str, StageSettings],
    takes: Mapping[str, int],
    given: Mapping[str, GivenRow],
    history: History,
    has_rig: bool = True,
    journalled: Collection[str] = (),
) -> ScanPlan:
    """Find out where every stage stands.

    Parameters
    ----------
    scan
        The scan's id, part of the capture id.
    method
        Stages and wires.
    settings, takes
        What the edits amount to (see `backend.jobs.edits`).
    given
        Results handed over with the scan: by the name of the stage that they replace, or of a type.
    history
        Finished runs and decisions by key, of this scan only.
    has_rig
        False: the frames were imported, capturing stages are unavailable unless given or journalled.
    journalled
        Capturing stages whose present take has frames in the journal: they can run without a rig.
    """
    planned: dict[str, PlannedStage] = {}
    for s in method.stages:
        base = PlannedStage(s, settings[s.name], takes.get(s.name, 0))
        can_capture = has_rig or s.name in journalled
        planned[s.name] = _plan_stage(
            base, method, scan, planned, given, history, has_rig, can_capture
        )
    return ScanPlan(scan, tuple(planned.values()))


def capture_id(scan: str, stage: str, take: int) -> str:
    """Identify what a capturing stage saw: not the moment, but scan, stage and take."""
    return f"{scan}/{stage}/{take}"


def _plan_stage(
    base: PlannedStage,
    method: Method,
    scan: str,
    earlier: Mapping[str, PlannedStage],
    given: Mapping[str, GivenRow],
    history: History,
    has_rig: bool,
    can_capture: bool,
) -> PlannedStage:
    s = base.stage
    if s.name in given:
        return replace(base, given=given[s.name])
    if base.settings.problem:
        return replace(base, missing=f"needs settings that hold. {base.settings.problem}")
    if s.captures and not can_capture:
        return replace(
            base, missing="needs a rig, and this scan has none: its frames were imported"
        )
    sources = [_source(w, earlier, given, has_rig) for w in method.wires[s.name]]
    if reasons := [x.missing for x in sources if x.missing]:
        return replace(base, missing="; ".join(reasons))
    if waits := [x.waits_for for x in sources if x.waits_for]:
        return replace(base, waits_for=waits[0])
    inputs = {x.name: x.row for x in sources}
    capture = capture_id(scan, s.name, base.take) if s.captures else None
    key = stage_key(
        stage=s.function_name,
        version=s.version,
        settings=without_cosmetics(base.settings.params),
        inputs={name: row.hash if row else None for name, row in inputs.items()},
        capture=capture,
    )
    return replace(
        base, key=key, inputs=inputs, run=history.finished(key), decision=history.decided(key)
    )


@dataclass(frozen=True)
class _Source:
    """Where one input comes from today."""

    name: str
    row: GivenRow | RunRow | None = None
    missing: str | None = None
    waits_for: str | None = None


def _source(
    wire: Wire,
    earlier: Mapping[str, PlannedStage],
    given: Mapping[str, GivenRow],
    has_rig: bool,
) -> _Source:
    name = wire.input.name
    if wire.source is None:
        return _given_source(wire, given, has_rig)
    maker = earlier[wire.source]
    if maker.result:
        return _Source(name, row=maker.result)
    if not maker.missing:
        return _Source(name, waits_for=wire.source)
    if wire.input.optional:
        return _Source(name)
    return _Source(name, missing=f"needs {maker.stage.title}, which {maker.missing}")


def _given_source(wire: Wire, given: Mapping[str, GivenRow], has_rig: bool) -> _Source:
    name, wanted = wire.input.name, wire.input.type
    row = given.get(wanted.__name__)
    if row:
        return _Source(name, row=row)
    if wanted in _OF_RIG and has_rig and RigFacts.__name__ not in given:
        return _Source(name, waits_for=RIG)
    if wire.input.optional:
        return _Source(name)
    reason = "the rig hands over none" if has_rig and wanted in _OF_RIG else "nothing supplies it"
    return _Source(name, missing=f"needs {words(wanted.__name__).lower()}, and {reason}")


def run_level(run: RunRow) -> Level:
    """Return the gravest level among a run's stored checks."""
    order = list(Level)
    return max((Level(check["level"]) for check in run.checks), key=order.index, default=Level.OK)


def gate_holds(
    review: Review, level: Level, decision: DecisionRow | None, *, unattended: bool = False
) -> bool:
    """Tell whether a finished result waits for the operator.

    An accepted result never does and a rejected one always. Otherwise a failed check holds under every rule,
    attended or not; an unattended run passes everything else.
    """
    if decision is not None:
        return decision.verdict is not Verdict.ACCEPT
    if level is Level.FAILURE or unattended:
        return level is Level.FAILURE
    return review is Review.ALWAYS or (review is Review.ON_WARNING and level is Level.WARNING)


def next_step(plan: ScanPlan, *, until: str | None, unattended: bool) -> Run | Gate | None:
    """Say what a job does next; None when nothing is left to do.

    Unavailable stages are passed over: what comes after them may have other inputs. Only a stage that was
    named as the last one has to be available.

    Raises
    ------
    StageUnavailableError
        If `until` is unavailable.
    """
    if until is not None and (missing := plan.stage(until).missing):
        raise StageUnavailableError(f"{until} is unavailable: {missing}.")
    for planned in plan.stages:
        available = not (planned.missing or planned.given)
        if available and (step := _step(planned, unattended)):
            return step
        if planned.name == until:
            return None
    return None


def _step(planned: PlannedStage, unattended: bool) -> Run | Gate | None:
    if planned.run is None:
        return Run(planned)
    level = run_level(planned.run)
    holds = gate_holds(planned.stage.review, level, planned.decision, unattended=unattended)
    return Gate(planned, level) if holds else None
