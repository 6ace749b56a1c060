"""What all frames of a camera say at one pixel: gray levels over an axis, with the line fitted to them."""

from collections.abc import Mapping
from typing import Any

from backend.contract.scans import PixelLevels
from backend.domain.errors import ConflictError, NotFoundError
from backend.domain.hints import Frames
from backend.domain.stage import shown_fields
from backend.jobs.loading import document_of, load_scan
from backend.services.context import Context
from backend.services.editing import find_stage
from backend.services.previews import value_at
from backend.storage.artifacts import ArtifactStore


def levels_at(
    context: Context, scan: str, stage: str, field: str, *, camera: str, x: int, y: int
) -> PixelLevels:
    """Return the gray levels of every frame of a camera at column x of row y, in the order of capture.

    Raises
    ------
    NotFoundError
        If the scan has no such stage, field, camera or pixel.
    ConflictError
        If the stage has no result now.
    """
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        found = find_stage(loaded, stage)
        result = loaded.plan.stage(stage).result
        if result is None:
            raise ConflictError(f"{found.title} has no result now: run it first.")
        document = document_of(repositories, result)
    hints = {shown.name: shown.hint for shown in shown_fields(found.output)}
    hint = hints.get(field)
    if not isinstance(hint, Frames):
        named = ", ".join(n for n, h in hints.items() if isinstance(h, Frames)) or "none"
        raise NotFoundError(f"{found.title} has no frames {field!r}; it has {named}.")
    return _levels(document, field, hint, context.store, camera, x, y)


def _levels(
    document: Mapping[str, Any],
    field: str,
    hint: Frames,
    store: ArtifactStore,
    camera: str,
    x: int,
    y: int,
) -> PixelLevels:
    frames = [f["$frame"] for f in document[field] or ()]
    own = [f for f in frames if f["camera"] == camera]
    if not own:
        cameras = ", ".join(dict.fromkeys(str(f["camera"]) for f in frames)) or "none"
        raise NotFoundError(f"There are no frames of camera {camera!r}; there are of {cameras}.")
    gray = [value_at(store.get(f["image"]["$array"]), x, y) for f in own]
    axis = _axis(document.get(hint.x or ""), store, camera, len(own))
    return PixelLevels(
        camera=camera,
        x=x,
        y=y,
        axis=axis,
        gray=tuple(float(g) for g in gray),
        exposure_ms=tuple(f["exposure_ms"] for f in own),
        full_scale_gray=float(2 ** int(own[0]["bit_depth"]) - 1),
        slope=_map_at(document.get(hint.slope or ""), store, camera, x, y),
        offset=_map_at(document.get(hint.offset or ""), store, camera, x, y),
    )


def _axis(value: Any, store: ArtifactStore, camera: str, count: int) -> tuple[float, ...] | None:
    """Return a number for each frame; None if the field isn't there or of another length."""
    value = _of_camera(value, camera)
    if isinstance(value, Mapping) and "$array" in value:
        value = store.get(value["$array"]).reshape(-1).tolist()
    if not isinstance(value, list) or len(value) != count:
        return None
    return tuple(float(v) for v in value)


def _map_at(value: Any, store: ArtifactStore, camera: str, x: int, y: int) -> float | None:
    value = _of_camera(value, camera)
    if not isinstance(value, Mapping) or "$array" not in value:
        return None
    found = value_at(store.get(value["$array"]), x, y)
    return None if found is None else float(found)


def _of_camera(value: Any, camera: str) -> Any:
    """Return a camera's own where there is one per camera."""
    if isinstance(value, Mapping) and "$array" not in value:
        return value.get(camera)
    return value
