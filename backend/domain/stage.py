"""A stage is a typed function; its signature is the declaration.

```python
@stage(title="Brightness zones", version=1, review=Review.ON_WARNING, checks=(zone_count,))
def zones(preview: Preview, params: ZonesParams) -> Zones:
    \"\"\"Split the scene's gray levels into zones that one exposure can serve.\"\"\"
```

A parameter named `params` holds the settings, one annotated `Shoot` makes the stage capture, one annotated
`Progress` lets it report, one annotated `LoadArray` lets it read the arrays that its settings refer to
(`ArrayHash`); all others are inputs, `X | None` optional ones. The result is a frozen dataclass
whose fields say by `Annotated[..., Hint]` how they want to be looked at.
"""

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from backend.domain.arrays import LoadArray
from backend.domain.checks import Check, CheckFunction
from backend.domain.errors import NotFoundError
from backend.domain.hints import Hint
from backend.domain.params import Params
from backend.domain.shots import Progress, Shoot
from backend.domain.states import Review


@dataclass(frozen=True)
class Input:
    """One result that a stage reads."""

    name: str
    type: type
    optional: bool


@dataclass(frozen=True)
class ShownField:
    """One field of a result and how it wants to be looked at."""

    name: str
    hint: Hint
    per_camera: bool
    """True if the field is a mapping from camera name to the thing shown."""


class NoParams(Params):
    """Settings of a stage that has none."""


@dataclass(frozen=True)
class Stage:
    """A declared stage; calling it calls the function."""

    name: str
    """The name within a method; `function_name` identifies the algorithm."""
    title: str
    version: int
    review: Review
    function: Callable[..., Any]
    params: type[Params]
    inputs: tuple[Input, ...]
    output: type
    captures: bool
    shoot_argument: str | None
    progress_argument: str | None
    load_argument: str | None
    checks: tuple[CheckFunction, ...]

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage's function as it is written."""
        return self.function(*args, **kwargs)

    @property
    def function_name(self) -> str:
        """Name of the algorithm: unique across methods, part of the key."""
        return self.function.__name__

    @property
    def doc(self) -> str:
        """The sentence for the operator."""
        return inspect.cleandoc(self.function.__doc__ or "")

    @property
    def shown(self) -> tuple[ShownField, ...]:
        """Fields of the result that have a hint, in order of declaration."""
        return shown_fields(self.output)

    def named(self, name: str) -> "Stage":
        """Repeat this stage in a method under another name, e.g. `refine_2`."""
        return dataclasses.replace(self, name=name)

    def run(
        self,
        inputs: Mapping[str, Any],
        params: Params,
        *,
        shoot: Shoot | None = None,
        progress: Progress | None = None,
        load: LoadArray | None = None,
    ) -> Any:
        """Call the function with everything its signature asks for, by name."""
        arguments: dict[str, Any] = {i.name: inputs.get(i.name) for i in self.inputs}
        if "params" in inspect.signature(self.function).parameters:
            arguments["params"] = params
        if self.shoot_argument:
            arguments[self.shoot_argument] = shoot
        if self.progress_argument:
            arguments[self.progress_argument] = progress or _silent
        if self.load_argument:
            arguments[self.load_argument] = load or _no_arrays
        return self.function(**arguments)

    def check(self, result: Any, params: Params) -> tuple[Check, ...]:
        """Grade a result by every check of the stage."""
        return tuple(check(result, params) for check in self.checks)

    def describe(self) -> dict[str, Any]:
        """Return the one description that API, UI and command line read, as JSON values."""
        return {
            "name": self.name,
            "title": self.title,
            "doc": self.doc,
            "version": self.version,
            "review": self.review.value,
            "captures": self.captures,
            "inputs": [
                {"name": i.name, "type": i.type.__name__, "optional": i.optional}
                for i in self.inputs
            ],
            "output": self.output.__name__,
            "settings": self.params.model_json_schema(),
            "shown": [
                {"name": f.name, "per_camera": f.per_camera, "hint": f.hint.describe()}
                for f in self.shown
            ],
        }


def stage(
    *,
    title: str,
    version: int,
    review: Review = Review.ON_WARNING,
    checks: tuple[CheckFunction, ...] = (),
) -> Callable[[Callable[..., Any]], Stage]:
    """Declare a function as a stage.

    Parameters
    ----------
    title
        Two or three words for the stepper.
    version
        To be raised whenever the same inputs and settings give another result.
    review
        When the finished stage waits for the operator. A failed check always stops an unattended run.
    checks
        Pure functions of (result, settings).

    Raises
    ------
    TypeError
        At import, if the signature isn't fully annotated, the result isn't a frozen dataclass
        or the function has no docstring.
    """

    def declare(function: Callable[..., Any]) -> Stage:
        signature = _read_signature(function)
        return Stage(
            name=function.__name__,
            title=title,
            version=version,
            review=review,
            function=function,
            checks=checks,
            **signature,
        )

    return declare


def shown_fields(result_type: type) -> tuple[ShownField, ...]:
    """Return the fields of a result type that have a hint, in order of declaration."""
    hints = typing.get_type_hints(result_type, include_extras=True)
    found = []
    for field in dataclasses.fields(result_type):
        annotation = hints[field.name]
        for extra in getattr(annotation, "__metadata__", ()):
            if isinstance(extra, Hint):
                found.append(ShownField(field.name, extra, _is_per_camera(annotation, extra)))
    return tuple(found)


def _is_per_camera(annotation: Any, hint: Hint) -> bool:
    inner = typing.get_args(annotation)[0]
    origin = typing.get_origin(inner)
    is_mapping = isinstance(origin, type) and issubclass(origin, Mapping)
    return is_mapping and hint.kind != "table"


def _read_signature(function: Callable[..., Any]) -> dict[str, Any]:
    name = function.__name__
    if not function.__doc__:
        raise TypeError(f"stage {name!r} has no docstring: the operator reads it")
    hints = typing.get_type_hints(function)
    if missing := [p for p in inspect.signature(function).parameters if p not in hints]:
        raise TypeError(f"stage {name!r}: annotate {missing}, the signature is the declaration")
    output = hints.pop("return", None)
    if not (dataclasses.is_dataclass(output) and _is_frozen(output)):
        raise TypeError(f"stage {name!r} has to return a frozen dataclass, not {output!r}")
    params = hints.pop("params", NoParams)
    shoot = _take(hints, Shoot)
    progress = _take(hints, Progress)
    load = _take(hints, LoadArray)
    return {
        "params": params,
        "inputs": tuple(
            _read_input(f"stage {name!r}", n, annotation) for n, annotation in hints.items()
        ),
        "output": output,
        "captures": shoot is not None,
        "shoot_argument": shoot,
        "progress_argument": progress,
        "load_argument": load,
    }


def read_inputs(who: str, function: Callable[..., Any]) -> tuple[Input, ...]:
    """Return what a function reads, all of its parameters being results: `X`, or `X | None` where it can do without.

    Raises
    ------
    TypeError
        At import, if a parameter isn't annotated so.
    """
    hints = typing.get_type_hints(function)
    hints.pop("return", None)
    return tuple(_read_input(who, n, annotation) for n, annotation in hints.items())


def _is_frozen(result_type: Any) -> bool:
    return bool(result_type.__dataclass_params__.frozen)


def _take(hints: dict[str, Any], wanted: type) -> str | None:
    for name, annotation in hints.items():
        if annotation is wanted:
            del hints[name]
            return name
    return None


def _read_input(who: str, name: str, annotation: Any) -> Input:
    members = [annotation]
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        members = [m for m in typing.get_args(annotation) if m is not type(None)]
    if len(members) != 1 or not isinstance(members[0], type):
        raise TypeError(f"{who}: input {name!r} has to be one type or `Type | None`")
    return Input(name, members[0], optional=members[0] is not annotation)


def _silent(done: float, text: str = "") -> None:
    """Report to nobody."""


def _no_arrays(array_hash: str) -> Any:
    """Have no arrays: a stage that is called without a store."""
    raise NotFoundError(f"There is no array {array_hash[:12]}: upload it, then set it again.")
