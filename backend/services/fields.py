"""The shown fields of a stored result, read from its document: no array is loaded."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

from backend.contract.scans import ArtifactRef, FieldView, FrameRef
from backend.domain.hints import Hint
from backend.domain.stage import Stage, shown_fields
from backend.storage.artifacts import ArtifactStore

_SIBLINGS = (
    "x",
    "y",
    "point",
    "slope",
    "offset",
    "fit",
    "valleys",
    "peaks",
    "normals",
    "colour",
    "faces",
)
"""Attributes of hints that name another field of the same result."""


_MOST_CHOSEN = 256
"""Arrays up to this size are shown as the value that a stage chose; larger ones are fetched."""


@dataclass(frozen=True)
class _Shown:
    name: str
    hint: dict[str, Any]
    per_camera: bool


def field_views(result_type: type, document: Mapping[str, Any]) -> tuple[FieldView, ...]:
    """Describe every shown field, and those that a hint refers to.

    A field without a hint of its own that another one's hint names (the axis of a curve) comes with the kind
    `data`: there to be fetched, not to be shown.
    """
    return tuple(
        _view(_with_texts(shown, document), document[shown.name])
        for shown in _shown(result_type)
        if shown.name in document
    )


def _with_texts(shown: _Shown, document: Mapping[str, Any]) -> _Shown:
    """Put the texts of a mask's labels into its hint where they depend on the result."""
    texts = document.get(str(shown.hint.get("names")))
    if not isinstance(texts, list):
        return shown
    labels = {number: str(text) for number, text in enumerate(texts, start=1)}
    return replace(shown, hint={**shown.hint, "labels": labels})


@dataclass(frozen=True)
class ShownResult:
    """What a client sees of a result."""

    fields: tuple[FieldView, ...]
    chosen: Mapping[str, Any]
    """Setting -> the value that the stage chose where the setting is automatic."""


def shown_result(stage: Stage, document: Mapping[str, Any], store: ArtifactStore) -> ShownResult:
    """Describe a stored result of a stage."""
    return ShownResult(field_views(stage.output, document), _chosen(stage, document, store))


def point_count(views: tuple[FieldView, ...]) -> int | None:
    """Return how many points a result has; None if it isn't a cloud."""
    for view in views:
        if view.hint["kind"] == "points":
            return math.prod(view.arrays[""].shape[:-1]) if "" in view.arrays else None
    return None


def small_value(value: Any, store: ArtifactStore) -> Any:
    """Return a stored value as JSON; an array of a few numbers as a list, a larger one as a reference."""
    if _is_array(value) and math.prod(value["shape"]) <= _MOST_CHOSEN:
        return store.get(value["$array"]).tolist()
    return plain(value)


def _chosen(stage: Stage, document: Mapping[str, Any], store: ArtifactStore) -> dict[str, Any]:
    chosen = {}
    for name, setting in stage.params.model_fields.items():
        extra = setting.json_schema_extra
        field = extra.get("auto") if isinstance(extra, dict) else None
        if isinstance(field, str):
            chosen[name] = small_value(document.get(field), store)
    return chosen


def plain(value: Any) -> Any:
    """Return a stored value as JSON for a client: NaN and infinity are None, arrays become references."""
    if isinstance(value, Mapping):
        if "$float" in value:
            return None
        if "$array" in value:
            return _artifact(value).model_dump(mode="json")
        return {name: plain(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    return value


@lru_cache(maxsize=256)
def _shown(result_type: type) -> tuple[_Shown, ...]:
    shown = [_Shown(f.name, f.hint.describe(), f.per_camera) for f in shown_fields(result_type)]
    named = {name for f in shown_fields(result_type) for name in _named_siblings(f.hint)}
    named -= {s.name for s in shown}
    hidden = [f.name for f in fields(result_type) if f.name in named]
    return (*shown, *(_Shown(name, {"kind": "data", "title": name}, False) for name in hidden))


def _named_siblings(hint: Hint) -> Iterator[str]:
    for attribute in _SIBLINGS:
        name = getattr(hint, attribute, None)
        if isinstance(name, str):
            yield name
    yield from getattr(hint, "scalars", ())


def _view(shown: _Shown, value: Any) -> FieldView:
    view = FieldView(name=shown.name, hint=shown.hint, per_camera=shown.per_camera)
    if shown.hint["kind"] == "frames":
        return view.model_copy(update={"frames": tuple(_frames(value))})
    by_camera = value if _is_per_camera(shown, value) else {"": value}
    arrays = {camera: _artifact(v) for camera, v in by_camera.items() if _is_array(v)}
    if arrays:
        return view.model_copy(update={"arrays": arrays})
    return view.model_copy(update={"value": plain(value)})


def _is_per_camera(shown: _Shown, value: Any) -> bool:
    if not isinstance(value, Mapping) or _is_array(value):
        return False
    return shown.per_camera or (bool(value) and all(_is_array(v) for v in value.values()))


def _is_array(value: Any) -> bool:
    return isinstance(value, Mapping) and "$array" in value


def _artifact(value: Mapping[str, Any]) -> ArtifactRef:
    # model_construct: a scan has hundreds of them, and the store wrote what is in the document.
    return ArtifactRef.model_construct(
        hash=value["$array"], shape=tuple(value["shape"]), dtype=value["dtype"]
    )


def _frames(value: Any) -> Iterator[FrameRef]:
    """Find the frames in whatever a stage keeps them in: a tuple, one per camera, nested."""
    if isinstance(value, Mapping) and "$frame" in value:
        frame = value["$frame"]
        yield FrameRef.model_construct(
            camera=frame["camera"],
            pattern=frame["pattern"],
            exposure_ms=plain(frame["exposure_ms"]),
            gain_db=frame["gain_db"],
            role=frame["role"],
            bit_depth=frame["bit_depth"],
            image=_artifact(frame["image"]),
        )
    elif isinstance(value, Mapping | list):
        for inner in value.values() if isinstance(value, Mapping) else value:
            yield from _frames(inner)
