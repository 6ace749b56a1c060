"""A method is a table of contents: its stages in order, wired by the types they read and make."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from backend.domain.frames import Frame
from backend.domain.rig import RigCalibration, RigFacts
from backend.domain.stage import Input, Stage, read_inputs


@dataclass(frozen=True)
class Wire:
    """Where one input of a stage comes from."""

    input: Input
    source: str | None
    """Name of the stage that makes it; None: it is given with the scan, or missing."""


@dataclass(frozen=True)
class Method:
    """A measuring method: name, title, stages, and what is given from outside."""

    name: str
    title: str
    stages: tuple[Stage, ...]
    given: tuple[type, ...] = (RigFacts, RigCalibration)
    doc: str = ""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Named sets of settings: `{"fast": {"exposures.budget": "fast"}}`."""
    importers: Mapping[str, Callable[[tuple[Frame, ...]], Any]] = field(default_factory=dict)
    """How imported frames become the result of a capturing stage: `{stage: function of frames}`, or, where
    the method doesn't capture them itself, a given result: `{name of its type: function of frames}`.
    Frames that name no stage belong to the first one."""
    files: Mapping[str, Callable[..., bytes]] = field(default_factory=dict)
    """Files that an export holds beside cloud and maps: `{name: function of results}`. The function's parameters are
    wired by their types, as a stage's inputs; without one that is required there is no such file."""

    def __post_init__(self) -> None:
        """Refuse, at import, names used twice and inputs that nothing can make."""
        names = [s.name for s in self.stages]
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise TypeError(f"method {self.name!r} lists {twice} twice: use stage.named(...)")
        known = {*names, *(t.__name__ for t in self.given)}
        if unknown := sorted(set(self.importers) - known):
            raise TypeError(
                f"method {self.name!r} imports frames for {unknown}, which is neither a stage of it nor given"
            )
        for s in self.stages:
            self._wire(s)
        for name in self.files:
            self.file_wires(name)

    def file_wires(self, name: str) -> tuple[Wire, ...]:
        """Return where the inputs of a file come from."""
        inputs = read_inputs(f"file {name!r}", self.files[name])
        return tuple(self._wire_input(f"file {name!r}", i, self.stages) for i in inputs)

    @cached_property
    def wires(self) -> Mapping[str, tuple[Wire, ...]]:
        """For each stage, where its inputs come from."""
        return {s.name: self._wire(s) for s in self.stages}

    @cached_property
    def handed(self) -> Mapping[str, str]:
        """Results that an operator may hand to a scan, by type: under which name they are given.

        That is the stage that the result replaces, or the type itself where no stage makes it. Facts and
        calibration come from the rig, and what an importer makes of frames comes with the frames.
        """
        places: dict[str, str] = {}
        for kind in self.given:
            makers = [s.name for s in self.stages if s.output is kind]
            if kind not in (RigFacts, RigCalibration) and not {
                kind.__name__,
                *makers,
            } & set(self.importers):
                places[kind.__name__] = makers[0] if makers else kind.__name__
        return places

    def stage(self, name: str) -> Stage:
        """Return the stage of that name; KeyError if there is none."""
        for s in self.stages:
            if s.name == name:
                return s
        raise KeyError(name)

    def type_named(self, name: str) -> type:
        """Return the result type (made or given) of that name; KeyError if there is none."""
        types = [*self.given, *(s.output for s in self.stages)]
        for t in types:
            if t.__name__ == name:
                return t
        raise KeyError(name)

    def type_of(self, name: str) -> type:
        """Return the type of the result that is handed over under a name: a stage's, or the given type itself."""
        for s in self.stages:
            if s.name == name:
                return s.output
        return self.type_named(name)

    def describe(self) -> dict[str, Any]:
        """Return the method's description as JSON values."""
        return {
            "name": self.name,
            "title": self.title,
            "doc": self.doc,
            "stages": [s.describe() for s in self.stages],
            "given": [t.__name__ for t in self.given],
            "presets": {name: dict(values) for name, values in self.presets.items()},
        }

    def _wire(self, reader: Stage) -> tuple[Wire, ...]:
        earlier = self.stages[: self.stages.index(reader)]
        who = f"stage {reader.name!r}"
        return tuple(self._wire_input(who, i, earlier) for i in reader.inputs)

    def _wire_input(self, reader: str, wanted: Input, earlier: tuple[Stage, ...]) -> Wire:
        makers = [s for s in earlier if s.output is wanted.type]
        if makers:
            return Wire(wanted, makers[-1].name)
        if wanted.type in self.given or wanted.optional:
            return Wire(wanted, None)
        raise TypeError(
            f"method {self.name!r}: {reader} reads {wanted.name!r}, a {wanted.type.__name__}, "
            f"which no earlier stage makes and which isn't given"
        )
