"""What the edits of a scan amount to: settings, takes, and what undo would take back. Pure."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from backend.domain.errors import InvalidSettingError
from backend.domain.method import Method
from backend.domain.stage import Stage
from backend.jobs.stage_settings import (
    StageSettings,
    check_values,
    require_arrays,
    require_stage,
)
from backend.storage.rows import EditKind, EditRow

TAKE = "take"
"""Field of the edits that take the pictures of a capturing stage again."""

FIRST_TAKE = 1


def standing(edits: Iterable[EditRow]) -> list[EditRow]:
    """Return the edits that hold: neither undone nor an undo themselves, oldest first."""
    rows = sorted(edits, key=lambda row: row.revision)
    undone = {row.reverts for row in rows if row.kind is EditKind.UNDO}
    return [row for row in rows if row.kind is not EditKind.UNDO and row.group not in undone]


def last_group(edits: Iterable[EditRow]) -> list[EditRow]:
    """Return the edits that undo would take back: the last request that still holds; empty if none."""
    rows = standing(edits)
    return [row for row in rows if row.group == rows[-1].group] if rows else []


def edited_values(edits: Iterable[EditRow]) -> dict[str, dict[str, Any]]:
    """Return what is edited now, `{stage: {field: value}}`, without takes."""
    values: dict[str, dict[str, Any]] = {}
    for row in standing(edits):
        fields = values.setdefault(row.stage, {})
        if row.kind is EditKind.SET:
            fields[row.field] = row.new
        elif row.kind is EditKind.RESET:
            fields.pop(row.field, None)
    return values


def present_takes(method: Method, edits: Iterable[EditRow]) -> dict[str, int]:
    """Return today's take of every capturing stage; the first is 1. Other stages have 0."""
    takes = {s.name: FIRST_TAKE if s.captures else 0 for s in method.stages}
    for row in standing(edits):
        if row.kind is EditKind.TAKE and row.stage in takes:
            takes[row.stage] = int(row.new)
    return takes


def fresh_take(edits: Iterable[EditRow], stage: str) -> int:
    """Return a take that no frame was ever captured under.

    One more than the highest ever used, undone ones included: redo, undo, redo has to take new pictures.
    """
    used = [int(row.new) for row in edits if row.kind is EditKind.TAKE and row.stage == stage]
    return max([FIRST_TAKE, *used]) + 1


def since(edits: Iterable[EditRow], revision: int) -> list[EditRow]:
    """Return the edits that a client which looked at `revision` doesn't know."""
    return [row for row in edits if row.revision > revision]


def resolve_settings(
    method: Method,
    *,
    preset: str | None,
    recipe: Mapping[str, Mapping[str, Any]],
    edits: Sequence[EditRow],
) -> dict[str, StageSettings]:
    """Lay preset, recipe and edits over the defaults of every stage.

    What is stored but can't be used any more (a field that a newer version dropped) doesn't raise:
    that stage gets defaults and a `problem`, so that the scan can still be opened.
    """
    preset_layer = preset_values(method, preset) if preset in method.presets else {}
    edited = edited_values(edits)
    return {
        s.name: _resolve(
            s,
            {
                "preset": preset_layer.get(s.name, {}),
                "recipe": recipe.get(s.name, {}),
                "edited": edited.get(s.name, {}),
            },
        )
        for s in method.stages
    }


def preset_values(method: Method, preset: str | None) -> dict[str, dict[str, Any]]:
    """Return a preset as `{stage: {field: value}}`; the method names fields as `stage.field`."""
    if preset is None:
        return {}
    if preset not in method.presets:
        known = ", ".join(method.presets) or "none"
        raise InvalidSettingError(
            f"{method.name} has no preset {preset!r}; its presets are: {known}."
        )
    values: dict[str, dict[str, Any]] = {}
    for path, value in method.presets[preset].items():
        stage, _, field = path.partition(".")
        values.setdefault(stage, {})[field] = value
    return values


def check_recipe(
    method: Method,
    preset: str | None,
    recipe: Mapping[str, Mapping[str, Any]],
    is_stored: Callable[[str], bool],
) -> dict[str, dict[str, Any]]:
    """Refuse a recipe that the method can't use; return it as its settings store it (`"3"` becomes 3.0).

    Parameters
    ----------
    method, preset, recipe
        What it is for, what it is laid over, and the recipe.
    is_stored
        Tells whether there is an array of a hash, that a setting may refer to.

    Raises
    ------
    InvalidSettingError
        Naming stage, field, value and what is allowed, or the presets or stages there are.
    """
    base = preset_values(method, preset)
    checked: dict[str, dict[str, Any]] = {}
    for name, values in recipe.items():
        stage = require_stage(method, name)
        params = check_values(stage, {**base.get(name, {}), **values})
        require_arrays(stage, params, is_stored)
        document = params.model_dump(mode="json")
        checked[name] = {field: document[field] for field in values}
    return checked


def _resolve(stage: Stage, layers: Mapping[str, Mapping[str, Any]]) -> StageSettings:
    sources = dict.fromkeys(stage.params.model_fields, "default")
    values: dict[str, Any] = {}
    for source, layer in layers.items():
        values.update(layer)
        sources.update(dict.fromkeys(layer, source))
    try:
        return StageSettings(check_values(stage, values), sources)
    except InvalidSettingError as error:
        defaults = dict.fromkeys(stage.params.model_fields, "default")
        return StageSettings(stage.params(), defaults, problem=error.sentence)
