"""Check settings against a stage's model, and say in one sentence what is allowed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from backend.domain.arrays import array_hashes
from backend.domain.errors import InvalidSettingError
from backend.domain.method import Method
from backend.domain.params import Params
from backend.domain.stage import Stage


@dataclass(frozen=True)
class StageSettings:
    """The settings of one stage, each with where it comes from."""

    params: Params
    sources: Mapping[str, str]
    """Field -> `default`, `preset`, `recipe` or `edited`."""
    problem: str | None = None
    """Why what is stored can't be used any more (an older version wrote it); `params` are defaults then."""

    @property
    def values(self) -> dict[str, Any]:
        """Every setting as a JSON value."""
        return self.params.model_dump(mode="json")


def check_values(stage: Stage, values: Mapping[str, Any]) -> Params:
    """Make a stage's settings of JSON values; what isn't named gets its default.

    Raises
    ------
    InvalidSettingError
        Naming stage, field, value and what is allowed.
    """
    for name in values:
        require_field(stage, name)
    try:
        return stage.params.model_validate(dict(values))
    except ValidationError as error:
        raise InvalidSettingError(_sentence(stage, error)) from None


def require_arrays(stage: Stage, params: Params, is_stored: Callable[[str], bool]) -> None:
    """Refuse settings that refer to arrays which aren't in the store.

    Raises
    ------
    InvalidSettingError
        Naming stage, field and hash.
    """
    for field, array_hash in array_hashes(params):
        if not is_stored(array_hash):
            raise InvalidSettingError(
                f"{stage.name}.{field} names the array {array_hash[:12]}..., which isn't stored here: "
                "upload it first, then set it."
            )


def require_field(stage: Stage, field: str) -> None:
    """Refuse a setting that the stage doesn't have, naming those it has."""
    known = list(stage.params.model_fields)
    if field in known:
        return
    there_are = f"it has {', '.join(known)}" if known else "it has none"
    raise InvalidSettingError(f"{stage.name} has no setting {field!r}: {there_are}.")


def require_stage(method: Method, name: str) -> Stage:
    """Return the stage of a method, or refuse, naming those there are."""
    try:
        return method.stage(name)
    except KeyError:
        known = ", ".join(s.name for s in method.stages)
        raise InvalidSettingError(
            f"{method.name} has no stage {name!r}; its stages are {known}."
        ) from None


def _sentence(stage: Stage, error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    message = first["msg"].removeprefix("Value error, ").removesuffix(".")
    if not first["loc"]:
        return f"{stage.name}: {message[:1].lower()}{message[1:]}."
    field = str(first["loc"][0])
    allowed = allowed_values(stage.params, field)
    reason = "" if allowed else f" ({message[:1].lower()}{message[1:]})"
    wanted = f": it has to be {allowed}" if allowed else ""
    return f"{stage.name}.{field} can't be {_shown(first['input'])}{wanted}{reason}."


def _shown(value: Any) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


_AUTOMATIC = " or null (automatic)"


def allowed_values(params: type[Params], field: str) -> str:
    """Say what a setting may be, e.g. `a number from 0 to 20 gray`; empty if its model is too rich for that."""
    schema = params.model_json_schema()
    described = schema["properties"][field]
    text = _describe(described, schema.get("$defs", {}))
    unit = described.get("unit")
    if not (text and unit):
        return text
    value, automatic, _ = text.partition(_AUTOMATIC)
    return f"{value} {unit}{automatic}"


def _describe(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        return _describe(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        return _alternatives([_describe(s, definitions) for s in schema["anyOf"]])
    if "enum" in schema or "const" in schema:
        return _alternatives([str(v) for v in schema.get("enum", [schema.get("const")])], "one of ")
    writer = _WRITERS.get(schema.get("type", ""))
    return writer(schema, definitions) if writer else ""


def _alternatives(texts: list[str], head: str = "") -> str:
    if not all(texts):
        return ""
    return head + ", ".join(texts) if head else " or ".join(texts)


def _number(schema: Mapping[str, Any], noun: str) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    start = f"from {low:g}" if low is not None else f"above {above:g}" if above is not None else ""
    end = f"to {high:g}" if high is not None else f"below {below:g}" if below is not None else ""
    if high is not None and low is None:
        end = f"up to {high:g}"
    if low is not None and not end:
        end = "up"
    step = schema.get("multipleOf")
    steps = f"in steps of {step:g}" if step is not None else ""
    return " ".join(filter(None, [noun, start, end, steps]))


def _array(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    low, high = schema.get("minItems"), schema.get("maxItems")
    if low is None and high is None:
        return "a list"
    if low == high:
        return f"a list of {low} values"
    count = f"{low or 0} to {high}" if high is not None else f"at least {low}"
    return f"a list of {count} values"


def _text(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    high = schema.get("maxLength")
    return f"a text of at most {high} characters" if high is not None else "a text"


_WRITERS = {
    "number": lambda schema, definitions: _number(schema, "a number"),
    "integer": lambda schema, definitions: _number(schema, "a whole number"),
    "boolean": lambda schema, definitions: "true or false",
    "null": lambda schema, definitions: "null (automatic)",
    "string": _text,
    "array": _array,
}
