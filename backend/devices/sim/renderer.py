"""From a projected pattern to the light on a camera's pixels."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from backend.devices.sim import kernels, optics, refresh
from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.transport import Transport


@dataclass(frozen=True)
class Shown:
    """What the projector shows at the moment, frozen: a new object for every pattern shown."""

    pattern: UInt8[np.ndarray, "h w"]
    """Never written to."""
    number: int
    """Counts everything ever shown; the cache's key."""

    def during(self, start_s: float, end_s: float) -> tuple[tuple["Shown", float], ...]:
        """Return itself: it stays until the exposure is over."""
        del start_s, end_s
        return ((self, 1.0),)


@runtime_checkable
class Light(Protocol):
    """What lights the scene: a pattern that stays for the whole exposure, or a display that is watched meanwhile."""

    def during(self, start_s: float, end_s: float) -> Sequence[tuple[Shown, float]]:
        """Return what was shown between two times of the rig's clock, each with its share of that time.

        Called when the exposure is over. The shares add up to 1.
        """
        ...


class Beam:
    """The projector's light, shared by the cameras: blurred pictures, computed once per pattern."""

    def __init__(self, config: SimulatedRigConfig, soft_variance_px2: float) -> None:
        self._period_ms = config.frame_period_ms
        self._variances = (
            config.projector_blur_px**2,
            config.projector_blur_px**2 + soft_variance_px2,
        )
        self._mean = refresh.mean_light(config.gamma, config.contrast_ratio)
        self._cache: OrderedDict[int, Float32[np.ndarray, "2 h w"]] = OrderedDict()
        self._lock = Lock()

    def pictures(
        self, shown: Sequence[tuple[Shown, float]], exposure_ms: float, phase: float
    ) -> Float32[np.ndarray, "2 h w"]:
        """Return the light of patterns during an exposure, in focus and at the largest defocus.

        `shown` are the patterns with their shares of the exposure; `phase` is where in its period the
        projector is when the exposure begins, in [0, 1).
        """
        pictures = [(self._pictures(one, exposure_ms, phase), share) for one, share in shown]
        if len(pictures) == 1:
            return pictures[0][0]
        mixed = np.zeros_like(pictures[0][0])
        for picture, share in pictures:
            mixed += np.float32(share) * picture
        return mixed

    def _pictures(
        self, shown: Shown, exposure_ms: float, phase: float
    ) -> Float32[np.ndarray, "2 h w"]:
        if self._period_ms is not None and not refresh.whole_periods(exposure_ms, self._period_ms):
            light = refresh.light_during(self._mean, exposure_ms, self._period_ms, phase)
            return self._blurred(shown.pattern, light)
        with (
            self._lock
        ):  # a second camera waits for the first one's picture instead of making its own
            if shown.number not in self._cache:
                self._cache[shown.number] = self._blurred(shown.pattern, self._mean)
                if len(self._cache) > 3:
                    self._cache.popitem(last=False)
            return self._cache[shown.number]

    def _blurred(
        self, pattern: UInt8[np.ndarray, "h w"], light: Float32[np.ndarray, "256"]
    ) -> Float32[np.ndarray, "2 h w"]:
        sharp = optics.projected(pattern, light, self._variances[0])
        if self._variances[0] == self._variances[1]:
            return np.stack([sharp, sharp])
        return np.stack([sharp, optics.projected(pattern, light, self._variances[1])])


@dataclass(frozen=True)
class LightPaths:
    """A camera's transport, with defocus as a share of the largest one in the scene."""

    transport: Transport
    mix: Float32[np.ndarray, "samples h w"]
    bounce_mix: Float32[np.ndarray, "n"]

    def light(
        self,
        pictures: Float32[np.ndarray, "2 hp wp"],
        *,
        white_e_per_ms: float,
        ambient_e_per_ms: float,
        lens_blur_px: float,
    ) -> Float32[np.ndarray, "h w"]:
        """Return the light on the sensor in [e/ms], lens blur included, glare not.

        Interpolating between a sharp and a soft picture in the variance of their blur is right to
        second order in the fringes' frequency, and exact at both ends.
        """
        paths = self.transport
        rate = np.empty(paths.ambient.shape, np.float32)
        white = np.float32(white_e_per_ms)
        with kernels.LOCK:
            kernels.light(
                *(paths.u_px, paths.v_px, paths.weight, self.mix, paths.ambient, pictures),
                *(white, np.float32(ambient_e_per_ms), rate),
            )
        extra = paths.bounces
        if extra.pixel.size:
            height, width = paths.ambient.shape
            rows = np.searchsorted(extra.pixel, np.arange(height + 1) * width)
            with kernels.LOCK:
                kernels.add_bounces(
                    *(rows, extra.pixel % width, extra.u_px, extra.v_px, extra.weight),
                    *(self.bounce_mix, pictures, white, rate),
                )
        return optics.blurred(rate, lens_blur_px)


def light_paths(
    transports: dict[str, Transport], config: SimulatedRigConfig
) -> tuple[dict[str, LightPaths], float]:
    """Prepare every camera's paths; also return the largest defocus variance, in [projector px^2]."""
    optic = {
        "focus_mm": config.distance_mm,
        "aperture_mm": config.projector_aperture_mm,
        "focal_px": config.projector_focal_per_width * config.projector_size[0],
    }
    direct = {n: optics.defocus_variance_px2(t.depth_mm, **optic) for n, t in transports.items()}
    bounced = {
        n: optics.defocus_variance_px2(t.bounces.depth_mm, **optic) for n, t in transports.items()
    }
    largest = max(
        [float(v[transports[n].weight > 0].max(initial=0.0)) for n, v in direct.items()]
        + [float(v.max(initial=0.0)) for v in bounced.values()]
    )
    scale = np.float32(1.0 / largest if largest > 0 else 0.0)
    paths = {
        name: LightPaths(
            transport,
            np.minimum(direct[name] * scale, np.float32(1.0)),
            bounced[name] * scale,
        )
        for name, transport in transports.items()
    }
    return paths, largest
