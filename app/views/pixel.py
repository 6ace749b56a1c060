"""What is known of one pixel: every map's value there, why it is missing, and its gray levels in all frames."""

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from app import markup
from app.client import ApiClient
from app.look import Look, fields_of_kind
from app.numbers import quantity
from app.views.mask import Labels
from backend.contract.colours import BACKGROUND_RGB
from backend.contract.rigs import CameraView, RigView


@dataclass(frozen=True)
class PixelFacts:
    """What is known of one pixel."""

    reasons: tuple[str, ...]
    """Why it is missing; empty if it isn't."""
    rows: tuple[tuple[str, str], ...]


def pixel_facts(
    api: ApiClient, look: Look, camera: str, shape: tuple[int, int] | None, x: int, y: int
) -> PixelFacts:
    """Ask every map of this camera up to the stage on the screen for one pixel; reasons first."""
    reasons: list[str] = []
    rows: list[tuple[str, str]] = []
    for stage in look.upto_stage():
        for field in fields_of_kind(stage, "picture", "mask"):
            reference = field.arrays.get(camera)
            if reference is None or not _contains(reference.shape, shape, x, y):
                continue
            value = api.value_at(reference.hash, x, y)
            title = str(field.hint.get("title") or field.name)
            if field.hint.get("kind") == "picture":
                rows.append((title, quantity(value, str(field.hint.get("unit") or ""))))
                continue
            labels = Labels.of(field.hint)
            found = labels.reasons(int(value or 0))
            if labels.bits:
                reasons += found
            rows.append((title, ", ".join(found) or "–"))
    return PixelFacts(tuple(dict.fromkeys(reasons)), tuple(rows))


def _contains(shape: tuple[int, ...], wanted: tuple[int, int] | None, x: int, y: int) -> bool:
    inside = len(shape) >= 2 and 0 <= y < shape[0] and 0 <= x < shape[1]
    return inside and (wanted is None or tuple(shape[:2]) == wanted)


def pixel_html(facts: PixelFacts) -> str:
    """Return why a pixel is missing, and all its values."""
    why = ""
    if facts.reasons:
        why = markup.div("ug-why", "Missing: " + markup.esc(", ".join(facts.reasons)))
    return why + markup.facts(_first_of_each(facts.rows))


def _first_of_each(rows: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Keep the newest of several maps with the same title."""
    kept: dict[str, str] = {}
    for title, text in rows:
        kept.setdefault(title, text)
    return list(kept.items())


def pixel_of(rig: RigView, point_mm: Any) -> tuple[str, int, int] | None:
    """Return the reference camera's pixel that sees a point of the rig's world, None if it has no model."""
    camera = next((c for c in rig.cameras if c.name == rig.reference), None)
    if camera is None or camera.model is None:
        return None
    x, y = _project(camera, np.asarray(point_mm, dtype=np.float64))
    inside = 0 <= x < camera.model.width_px and 0 <= y < camera.model.height_px
    return (camera.name, x, y) if inside else None


def _project(camera: CameraView, point_mm: Any) -> tuple[int, int]:
    assert camera.model is not None, "asked only of a camera with a model"
    pose = camera.camera_from_world
    R = np.array(pose.R) if pose else np.eye(3)
    t = np.array(pose.t_mm) if pose else np.zeros(3)
    pixels, _ = cv2.projectPoints(
        point_mm[None],
        cv2.Rodrigues(R)[0],
        t,
        np.array(camera.model.K),
        np.array(camera.model.distortion),
    )
    u, v = pixels[0, 0]
    return round(float(u)), round(float(v))


def decoded(body: bytes) -> Any:
    """Return RGB from the bytes of a picture; what is transparent gets the background's colour."""
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None, "the API sends PNG and JPEG"
    if picture.ndim == 2:
        return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    rgb = cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2RGB)
    if picture.shape[2] == 4:
        rgb[picture[..., 3] == 0] = BACKGROUND_RGB
    return rgb


def decoded_url(address: str) -> Any:
    """Return RGB from a picture that is contained in its address."""
    return decoded(base64.b64decode(address.partition(",")[2]))
