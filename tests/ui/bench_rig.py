"""A rig in real time for tests of the rig's page: two cameras, and a projector whose light comes 40 ms late."""

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from backend.devices.errors import DeviceTimeout
from backend.devices.link import Link
from backend.devices.protocols import (
    Camera,
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    LinkState,
    Presented,
    ProjectorCapabilities,
    Range,
    TriggerSource,
)
from backend.devices.refusals import (
    refuse_impossible,
    refuse_level,
    refuse_trigger,
    refuse_unloaded,
)
from backend.domain.rig import CameraFacts, ProjectorFacts, RigCalibration, RigFacts

SIZE = 320, 240
SCREEN = 320, 200
LAG_S = 0.04
_GRAY_PER_MS = 9.0
"""Of the brightest place under white light at 0 dB."""


class BenchProjector(Link):
    """Acknowledges at once; its light changes `LAG_S` later."""

    def __init__(self, settle_ms: float | None) -> None:
        super().__init__("projector", DeviceInfo("bench", "late screen", "P-1", "bench"))
        self.capabilities = ProjectorCapabilities(size=SCREEN, refresh_hz=60.0)
        self.settle_ms = settle_ms
        self._closed = threading.Event()
        self._loaded: tuple[UInt8[np.ndarray, "h w"], ...] = ()
        self._changes: list[tuple[float, UInt8[np.ndarray, "h w"]]] = [(0.0, _even(0))]

    def open(self) -> None:
        self._state = LinkState.READY

    def close(self) -> None:
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        self.open()

    def load(self, patterns: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
        self._need_link()
        self._loaded = tuple(patterns)

    def show(self, index: int, timeout_s: float = 2.0) -> Presented:
        refuse_unloaded(self.name, index, len(self._loaded))
        return self._change(index, self._loaded[index])

    def blank(self, level: int = 0) -> Presented:
        refuse_level(self.name, level)
        return self._change(-1, _even(level))

    def light(self, start_s: float, end_s: float) -> Float[np.ndarray, "h w"]:
        """Return the mean light of an exposure, 0..1."""
        changes = self._changes[-8:]
        times = [t for t, _ in changes[1:]] + [np.inf]
        parts = [
            (max(0.0, min(end_s, after) - max(start_s, at)), picture)
            for (at, picture), after in zip(changes, times, strict=True)
        ]
        total = sum(part for part, _ in parts) or 1.0
        seen = [picture * (part / total / 255.0) for part, picture in parts if part]
        return np.asarray(np.sum(seen, axis=0), np.float64)

    def _change(self, index: int, picture: UInt8[np.ndarray, "h w"]) -> Presented:
        self._need_link()
        self._changes.append((time.monotonic() + LAG_S, picture))
        self._closed.wait((self.settle_ms or 0.0) / 1000.0)
        return Presented(index, time.monotonic(), None, confirmed=self.settle_ms is not None)


class BenchCamera(Link):
    """Sees the screen on a textured wall, with noise."""

    def __init__(self, name: str, projector: BenchProjector, seed: int) -> None:
        super().__init__(name, DeviceInfo("bench", "eye", f"C-{seed}", "bench", address="10.0.0.2"))
        self.capabilities = CameraCapabilities(
            SIZE, ("Mono8",), Range(100.0, 500_000.0, 0.0, "us"), Range(0.0, 24.0, 0.1, "dB"), (TriggerSource.SOFTWARE,)
        )  # fmt: skip
        self.settings = CameraSettings(10_000.0, 0.0, "Mono8")
        self._projector = projector
        self._random = np.random.default_rng(seed)
        texture = cv2.GaussianBlur(self._random.uniform(0.1, 1.0, SIZE[::-1]), (0, 0), 1.2)
        self._wall = np.linspace(0.35, 1.0, SIZE[0])[None, :] * texture / texture.max()
        self._triggered: list[float] = []
        self._aborted = threading.Event()
        self.frames = 0

    def open(self) -> None:
        self._state = LinkState.READY

    def close(self) -> None:
        self.abort()
        self._state = LinkState.CLOSED

    def reconnect(self, timeout_s: float = 10.0) -> None:
        self.open()

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._need_link()
        wanted = replace(settings, pixel_format=settings.pixel_format or "Mono8")
        refuse_impossible(self.name, wanted, self.capabilities)
        self.settings = wanted
        return wanted

    def arm(self, n_frames: int | None = None) -> None:
        self._need_link()
        self._aborted.clear()
        self._triggered.clear()
        self._state = LinkState.ARMED

    def disarm(self) -> None:
        if self._state is LinkState.ARMED:
            self._state = LinkState.READY

    def abort(self) -> None:
        self._aborted.set()
        self.disarm()

    def trigger(self) -> None:
        self._need_link()
        refuse_trigger(self.name, self.settings, armed=self._state is LinkState.ARMED)
        self._triggered.append(time.monotonic())

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        self._need_link()
        if not self._triggered:
            raise DeviceTimeout(self.name, "no frame came")
        start_s = self._triggered.pop(0)
        exposure_s = self.settings.exposure_us * 1e-6
        if self._aborted.wait(max(0.0, start_s + exposure_s - time.monotonic())):
            raise DeviceTimeout(self.name, "waiting for a frame was aborted; arm again")
        self.frames += 1
        return Frame(
            self._picture(start_s, exposure_s), "Mono8", 8, self.frames, self.settings.exposure_us,
            self.settings.gain_db, start_s, time.monotonic(),
        )  # fmt: skip

    def _picture(self, start_s: float, exposure_s: float) -> UInt8[np.ndarray, "h w"]:
        light = cv2.resize(self._projector.light(start_s, start_s + exposure_s), SIZE)
        gain = 10 ** (self.settings.gain_db / 20)
        gray = _GRAY_PER_MS * 1e3 * exposure_s * gain * self._wall * light
        noisy = gray + (0.8 + 0.05 * np.sqrt(gray)) * self._random.standard_normal(gray.shape)
        gray8: UInt8[np.ndarray, "h w"] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return gray8


class BenchRig:
    """Both cameras and the projector."""

    info = DeviceInfo("bench", "rig", simulated=True)

    def __init__(self, name: str, settle_ms: float | None = None) -> None:
        self.name = name
        self.projector = BenchProjector(settle_ms)
        self.eyes = {
            side: BenchCamera(side, self.projector, seed)
            for seed, side in enumerate(("left", "right"))
        }

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self.eyes

    def open(self) -> None:
        for device in (self.projector, *self.eyes.values()):
            device.open()

    def close(self) -> None:
        for device in (*self.eyes.values(), self.projector):
            device.close()

    def __enter__(self) -> "BenchRig":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def facts(self) -> RigFacts:
        camera = CameraFacts(*SIZE, 8, 0.1, 500.0, 0.0, 10_000.0, 8.0, 24.0)
        return RigFacts(
            dict.fromkeys(self.eyes, camera), "left", ProjectorFacts(*SCREEN, 1000 / 60)
        )

    def calibration(self) -> RigCalibration | None:
        return None


def _even(level: int) -> UInt8[np.ndarray, "h w"]:
    return np.full(SCREEN[::-1], level, np.uint8)


class BenchRigs:
    """Opens such rigs and remembers them; a latency that was kept counts for the next one."""

    def __init__(self, settles: Any = lambda name: None) -> None:
        self.opened: list[BenchRig] = []
        self._settles = settles

    def __call__(self, name: str, options: Mapping[str, Any]) -> BenchRig:
        self.opened.append(BenchRig(name, self._settles(name)))
        return self.opened[-1]
