"""From what the screen shows to the light on the camera's pixels."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from backend.devices.sim import kernels, lcd_kernels, optics
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.reflection import Reflected
from backend.devices.sim.renderer import Shown

_KEPT = 3


@dataclass(frozen=True)
class Footprints:
    """Which box of the screen each pixel sees in the mirror, in screen [px], and how brightly."""

    u_px: Float32[np.ndarray, "h w"]
    v_px: Float32[np.ndarray, "h w"]
    half_u_px: Float32[np.ndarray, "h w"]
    half_v_px: Float32[np.ndarray, "h w"]
    weight: Float32[np.ndarray, "h w"]
    """Share of the pixel on the mirror, times loss on the way."""
    ambient: Float32[np.ndarray, "h w"]
    """Luminance of what is neither mirror nor screen, as far as the pixel sees it."""


def footprints(
    seen: Reflected, coverage: Float64[np.ndarray, "h w"], config: SimulatedLcdConfig
) -> Footprints:
    """Prepare the pixels' views of the screen.

    A pixel's square, seen in the mirror, is a parallelogram on the screen; the box has its variance along
    the screen's axes. `coverage` is the share of each pixel that lies on the mirror.
    """
    width, height = config.screen_size
    u, v = seen.shares[..., 0] * width - 0.5, seen.shares[..., 1] * height - 0.5
    half_u, half_v = _half_box(u), _half_box(v)
    meets = np.isfinite(u + v) & (coverage > 0)
    loss = np.where(meets, np.abs(seen.incidence) ** config.viewing_loss, 0.0)
    on_screen = _share_inside(u, half_u, width) * _share_inside(v, half_v, height)
    weight = np.where(meets, coverage * loss, 0.0)
    hidden = 1.0 - np.where(meets, coverage * on_screen, 0.0)
    maps = (u, v, half_u, half_v, weight, config.surround_share * hidden)
    return Footprints(*(np.nan_to_num(m).astype(np.float32) for m in maps))


def _half_box(position: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    across = np.hypot(np.gradient(position, axis=0), np.gradient(position, axis=1))
    known = across[np.isfinite(across)]
    usual = float(np.median(known)) if known.size else 1.0
    return np.asarray(np.clip(0.5 * np.where(np.isfinite(across), across, usual), 0.01, 500.0))


def _share_inside(
    centre: Float64[np.ndarray, "h w"], half: Float64[np.ndarray, "h w"], size: int
) -> Float64[np.ndarray, "h w"]:
    first, last = -0.5, size - 0.5
    seen = np.clip(centre + half, first, last) - np.clip(centre - half, first, last)
    return np.asarray(seen / (2.0 * half))


class Panel:
    """The screen's luminance as the camera's lens blurs it: a picture per pattern, kept a while."""

    def __init__(self, config: SimulatedLcdConfig, luminance: Float64[np.ndarray, "256"]) -> None:
        self._luminance = luminance.astype(np.float32)
        self._variance_px2 = (config.screen_blur_mm / config.pixel_pitch_mm) ** 2
        self._cache: OrderedDict[tuple[int, float], Float32[np.ndarray, "h w"]] = OrderedDict()

    def picture(
        self,
        pattern: UInt8[np.ndarray, "h w"],
        before: UInt8[np.ndarray, "h w"],
        share_before: float,
        number: int,
    ) -> Float32[np.ndarray, "h w"]:
        """Return the luminance, white being 1; interpolated between pixels its blur is as asked.

        `share_before` of the time the panel still showed what it did before; `number` tells patterns apart.
        """
        key = (number, round(share_before, 7))
        if key not in self._cache:
            picture = optics.projected(pattern, self._luminance, self._variance_px2)
            if key[1] > 0:
                mix = np.float32(key[1])
                old = optics.projected(before, self._luminance, self._variance_px2)
                picture = (1 - mix) * picture + mix * old
            self._cache[key] = picture
            if len(self._cache) > _KEPT:
                self._cache.popitem(last=False)
        return self._cache[key]

    def steady(self, shown: Shown) -> Float32[np.ndarray, "h w"]:
        """Return the luminance of what is there already: a real panel's delay shows in what is shown when."""
        return self.picture(shown.pattern, shown.pattern, 0.0, shown.number)


def light(
    views: Footprints, picture: Float32[np.ndarray, "hs ws"], lens_blur_px: float
) -> Float32[np.ndarray, "h w"]:
    """Return the luminance that each pixel sees, the screen's white being 1."""
    out = np.empty(views.u_px.shape, np.float32)
    with kernels.LOCK:
        lcd_kernels.gather(
            picture,
            *(views.u_px, views.v_px, views.half_u_px, views.half_v_px),
            *(views.weight, views.ambient, out),
        )
    return optics.blurred(out, lens_blur_px)
