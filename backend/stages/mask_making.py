"""What the stages that make intensity masks share: settings, and the way from pixels' needs to a mask."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from backend.domain.arrays import ArrayHash, LoadArray
from backend.domain.checks import Check, at_least
from backend.domain.errors import StageFailedError
from backend.domain.params import Params, setting
from backend.domain.rig import CameraFacts, ProjectorFacts, RigFacts
from backend.numerics.intensity_mask import Need, light_need, scatter, smooth, widen_dark
from backend.stages.base_exposure import BaseExposure
from backend.stages.code_map import CodeMap
from backend.stages.intensity_mask import IntensityMask
from backend.stages.pixel_response import PixelResponse

_DARKENS_ALL = 0.02
"""A mask this dark on average leaves nothing to measure with."""


class MaskParams(Params):
    """How bright the scene may get under the mask, and what the operator changes about it."""

    target: float = setting(0.85, title="Brightest gray wanted", ge=0.2, le=0.99)
    """Share of the full scale that the white field brings at most: the rest is room for noise and for a mask
    that is a little off."""
    contrast: float = setting(0.06, title="Contrast kept", ge=0, le=0.5, advanced=True)
    """Share of the full scale: beside something bright a dark pixel is dimmed only as far as this is left."""
    least_code: int = setting(3, title="Darkest code of the mask", ge=1, le=128, advanced=True)
    """No pixel is dimmed below this projected code: coarser steps than the scene needs would follow."""
    cameras: Literal["all", "reference"] = setting("all", title="Cameras served", advanced=True)
    """All: no camera is over-exposed, so points of every camera count; reference: only that one's highlights
    dim the light, the other camera may saturate."""
    smoothing_px: float = setting(2.0, title="Smoothing", unit="px", ge=0, le=10, advanced=True)
    """Radius over which the mask is smoothed between edges of the scene: a rough mask moves stripe edges."""
    scale: float = setting(1.0, title="Scale", unit="x", gt=0, le=4)
    """The finished mask is multiplied with this: less than 1 darkens everything."""
    paint: ArrayHash | None = setting(None, title="Painted mask")
    """A picture of the projector's size that replaces the mask where it isn't transparent (NaN): factors from
    0 to 1, or gray levels where the largest means full light."""


@dataclass(frozen=True)
class View:
    """One camera's part in a mask: what its pixels need, and where they look in the projector."""

    need: Need
    map: CodeMap


def served_cameras(facts: RigFacts, params: MaskParams) -> tuple[str, ...]:
    """Return the cameras that the mask is made for, the reference first."""
    others = tuple(name for name in facts.cameras if name != facts.reference)
    return (facts.reference, *others) if params.cameras == "all" else (facts.reference,)


def pixel_need(
    name: str,
    response: PixelResponse,
    base: BaseExposure,
    camera: CameraFacts,
    projector: ProjectorFacts,
    params: MaskParams,
) -> Need:
    """Say what light every pixel of a camera can take; one that saturated under every field can take the least."""
    least_factor = least_light(projector, params)
    need = light_need(
        response.gain[name],
        response.offset_gray[name],
        target_gray=params.target * camera.full_scale_gray,
        contrast_gray=params.contrast * camera.full_scale_gray,
        least_factor=least_factor,
    )
    blinded = np.isnan(response.gain[name]) & base.lit[name]
    return Need(
        np.where(blinded, np.float32(least_factor), need.most),
        np.where(blinded, np.float32(least_factor), need.least),
    )


def least_light(projector: ProjectorFacts, params: MaskParams) -> float:
    """Return the share of full light that the darkest code of the mask gives."""
    return float((params.least_code / 255) ** projector.gamma)


def gather(
    views: Sequence[View], projector: ProjectorFacts, *, dilation_px: float, smoothing_px: float
) -> Float32[np.ndarray, "h w"]:
    """Make a mask: every projector pixel gives what the most easily dazzled of those that look at it can take.

    Dark regions are widened, as places are known to a pixel or so, but not so far that a dark pixel beside
    them loses its contrast. Projector pixels that nobody looks at keep full light.
    """
    shape = projector.height_px, projector.width_px
    direct = np.ones(shape, np.float32)
    floor = np.zeros(shape, np.float32)
    for view in views:
        where = view.map.projector_px, view.map.projector_row_px
        scatter(view.need.most, *where, into=direct)
        scatter(view.need.least, *where, into=floor, largest=True)
    widened = widen_dark(direct, dilation_px)
    return smooth(np.maximum(widened, np.minimum(direct, floor)), smoothing_px)


def shown_factor(
    factor: Float[np.ndarray, "h w"], projector: ProjectorFacts
) -> Float32[np.ndarray, "h w"]:
    """Return the light that the projector really shows of a mask: it has 256 codes."""
    codes = np.rint(np.float32(255) * factor ** np.float32(1 / projector.gamma))
    return np.asarray((codes / np.float32(255)) ** np.float32(projector.gamma), np.float32)


def touched_up(
    factor: Float32[np.ndarray, "h w"], params: MaskParams, load: LoadArray
) -> Float32[np.ndarray, "h w"]:
    """Apply what the operator painted and scaled.

    Raises
    ------
    StageFailedError
        If the painted picture isn't of the projector's size, or isn't a picture.
    """
    painted = factor
    if params.paint is not None:
        picture = _painted(load(params.paint), factor.shape)
        painted = np.where(np.isnan(picture), factor, picture)
    return np.asarray(np.clip(painted * np.float32(params.scale), 0, 1), np.float32)


def _painted(
    picture: np.ndarray[tuple[int, ...], np.dtype[np.generic]], shape: tuple[int, ...]
) -> Float32[np.ndarray, "h w"]:
    if picture.shape != shape:
        raise StageFailedError(
            f"The painted mask has {' x '.join(map(str, picture.shape[::-1]))} px, the projector "
            f"{shape[1]} x {shape[0]}: paint it at the projector's size."
        )
    values = np.asarray(picture).astype(np.float32)
    if picture.dtype.kind in "ui":
        values /= np.float32(2 ** (8 * picture.dtype.itemsize) - 1)
    return values


def not_too_dark(result: IntensityMask, params: MaskParams) -> Check:
    """Fail where a mask darkens everything."""
    mean = float(result.factor.mean())
    return at_least(
        "light left", mean, warning=2.5 * _DARKENS_ALL, failure=_DARKENS_ALL / 10,
        sentence=f"the mask lets {mean:.1%} of the light through on average",
        remedy="it darkens nearly everything: shorten the base exposure or raise the scale",
    )  # fmt: skip
