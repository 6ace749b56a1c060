"""The latency calibration, on a screen that lags by a known time and cameras that integrate its light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backend.devices.drivers.page_projector import PageProjector
from backend.devices.errors import IncompleteFrame
from backend.devices.pages import PageDesk
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    Frame,
    Presented,
    ProjectorCapabilities,
    Range,
    TriggerSource,
)
from backend.devices.rig_shelf import RigShelf
from backend.domain.errors import StageFailedError
from backend.numerics.settling import Settling, first_complete_ms
from backend.services import latency

PERIOD_S = 1 / 240


class VirtualTime:
    """Goes on when somebody waits."""

    def __init__(self) -> None:
        self._now_s = 100.0

    def now_s(self) -> float:
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        self._now_s += duration_s


class LaggingScreen:
    """Acknowledges at once, and changes `lag_s` later."""

    name = "projector"

    def __init__(self, lag_s: float, clock: VirtualTime, refresh_hz: float = 240.0) -> None:
        self.capabilities = ProjectorCapabilities(size=(64, 48), refresh_hz=refresh_hz)
        self.lag_s, self.clock = lag_s, clock
        self.settle_ms: float | None = 99.0
        self.changes: list[tuple[float, int]] = [(0.0, 0)]

    def blank(self, level: int = 0) -> Presented:
        if self.settle_ms:
            self.clock.sleep(self.settle_ms / 1000.0)
        self.changes.append((self.clock.now_s() + self.lag_s, level))
        return Presented(-1, self.clock.now_s(), None, confirmed=False)

    def light(self, start_s: float, end_s: float) -> float:
        """Return the mean level over a time."""
        times = [t for t, _ in self.changes] + [np.inf]
        total = sum(
            level * max(0.0, min(end_s, after) - max(start_s, at))
            for (at, level), after in zip(self.changes, times[1:], strict=True)
        )
        return total / (end_s - start_s)


class Camera:
    """Sees the screen on a part of its picture."""

    capabilities = CameraCapabilities((32, 24), ("Mono8",), Range(1000, 1e6), Range(0, 0), ())

    def __init__(
        self, name: str, screen: LaggingScreen, gray: float = 200.0, bits: int = 8
    ) -> None:
        self.name, self._screen, self._gray, self._bits = name, screen, gray, bits
        self.settings = CameraSettings(1000.0)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self.settings = settings
        return settings

    def arm(self, n_frames: int | None = None) -> None: ...
    def disarm(self) -> None: ...

    def trigger(self) -> None:
        clock = self._screen.clock
        now_s = clock.now_s()
        end_s = now_s + self.settings.exposure_us * 1e-6
        clock.sleep(end_s - now_s)
        self._light = self._screen.light(now_s, end_s)

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        picture = np.full((24, 32), 4.0)
        picture[4:20, 4:28] += self._gray * self._light / 255.0
        picture *= (2**self._bits - 1) / 255
        return Frame(
            picture.round().astype(np.uint8 if self._bits == 8 else np.uint16),
            f"Mono{self._bits}",
            self._bits,
            0,
            self.settings.exposure_us,
            0.0,
            None,
            0.0,
        )


def _silent(done: float, text: str = "") -> None:
    """Nobody listens."""


def measured(
    lag_s: float, gray: float = 200.0, *, bits: int = 8, refresh_hz: float = 240.0
) -> latency.Latency:
    clock = VirtualTime()
    screen = LaggingScreen(lag_s, clock, refresh_hz)
    cameras = [Camera(name, screen, gray, bits) for name in ("left", "right")]
    try:
        return latency.latency_of(screen, cameras, _silent, repetitions=10, clock=clock)
    finally:
        assert screen.settle_ms == 99.0


@pytest.mark.parametrize("lag_ms", [0.0, 20.0, 60.0])
def test_the_lag_is_found_and_a_period_more_is_waited(lag_ms: float) -> None:
    found = measured(lag_ms / 1000.0)
    period_ms = 1000 * PERIOD_S
    assert lag_ms <= found.settle_ms - period_ms <= lag_ms + period_ms / 2
    assert found.up[-1] > 0.98
    assert found.down[-1] > 0.98


class UnsteadyScreen(LaggingScreen):
    """Is slower now and then."""

    def blank(self, level: int = 0) -> Presented:
        self.lag_s = 0.030 if len(self.changes) % 9 == 0 else 0.020
        return super().blank(level)


def test_the_slowest_of_many_changes_counts() -> None:
    clock = VirtualTime()
    screen = UnsteadyScreen(0.0, clock)
    found = latency.latency_of(
        screen, [Camera("left", screen)], _silent, repetitions=10, clock=clock
    )
    assert found.settle_ms >= 30.0 + 1000 * PERIOD_S


class LossyCamera(Camera):
    """Loses a picture now and then."""

    taken = 0

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        self.taken += 1
        if self.taken % 11 == 0:
            raise IncompleteFrame(self.name, "frame 11 arrived with packets missing; take it again")
        return super().get_frame(timeout_s)


def test_a_lost_picture_is_taken_again() -> None:
    clock = VirtualTime()
    screen = LaggingScreen(0.020, clock)
    cameras = [LossyCamera("left", screen), Camera("right", screen)]
    found = latency.latency_of(screen, cameras, _silent, repetitions=10, clock=clock)
    assert found.settle_ms == measured(0.020).settle_ms


class LosingCamera(Camera):
    """Loses every picture."""

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        raise IncompleteFrame(self.name, "frame 1 arrived with packets missing; take it again")


def test_a_camera_that_loses_every_picture_is_named() -> None:
    clock = VirtualTime()
    screen = LaggingScreen(0.020, clock)
    with pytest.raises(IncompleteFrame, match="left"):
        latency.latency_of(
            screen, [LosingCamera("left", screen)], _silent, repetitions=10, clock=clock
        )


def test_only_delays_that_may_be_long_enough_are_repeated() -> None:
    clock = VirtualTime()
    screen = LaggingScreen(0.060, clock, refresh_hz=60.0)
    told: list[float] = []
    latency.latency_of(
        screen,
        [Camera("left", screen)],
        lambda done, text="": told.append(done),
        repetitions=10,
        clock=clock,
    )
    assert told == sorted(told)
    too_short = 8  # half periods of 60 Hz in 60 ms
    assert 2 * 3 * 10 < len(screen.changes) / 2 <= 2 * (too_short + 3 + 3 * 10) + 3
    assert clock.now_s() - 100.0 < 60.0


def test_cameras_that_see_nothing_are_named() -> None:
    with pytest.raises(StageFailedError, match="Camera left doesn't see the projector's light"):
        measured(0.0, gray=1.0)


def test_a_change_counts_as_over_when_all_cameras_and_repetitions_agree() -> None:
    shares = np.ones((2, 2, 4))
    shares[1, 0, 1] = 0.9
    assert Settling(np.array([0.0, 8.0, 17.0, 25.0]), shares).over_ms == 17.0
    shares[0, 1, 3] = 0.5
    assert np.isnan(first_complete_ms(np.array([0.0, 8.0, 17.0, 25.0]), shares))


def test_twelve_bits_are_judged_on_their_own_scale() -> None:
    assert measured(0.02, bits=12).settle_ms == measured(0.02).settle_ms


def test_a_camera_that_waits_for_a_line_is_triggered_by_software() -> None:
    clock = VirtualTime()
    screen = LaggingScreen(0.0, clock)
    camera = Camera("left", screen)
    camera.settings = CameraSettings(1000.0, trigger=TriggerSource.LINE1)
    latency.latency_of(screen, [camera], _silent, repetitions=1, clock=clock)
    assert camera.settings.trigger is TriggerSource.SOFTWARE


def shelf_with_bench(folder: Path, projector: str) -> RigShelf:
    text = f"cameras: {{left: {{driver: aravis, address: 192.0.2.2}}}}\nprojector: {{driver: page, {projector}}}"
    (folder / "bench.yaml").write_text(text)
    return RigShelf(folder, PageDesk())


def settle_ms(shelf: RigShelf) -> float | None:
    projector = shelf.open("bench", {}).projector
    assert isinstance(projector, PageProjector)
    return projector.settle_ms


@pytest.mark.parametrize(
    ("projector", "same"),
    [
        ("size: 64x48, refresh_hz: 60", True),
        ("size: 64x48", True),
        ("size: 64x48, refresh_hz: null", True),
        ("size: 128x96, refresh_hz: 60", False),
        ("size: 64x48, refresh_hz: 75", False),
    ],
)
def test_it_holds_for_the_mode_that_it_was_measured_in(
    projector: str, same: bool, tmp_path: Path
) -> None:
    shelf = shelf_with_bench(tmp_path, projector)
    found = measured(0.02, refresh_hz=60.0)
    found.keep(shelf.folder, "bench")
    assert settle_ms(shelf) == (found.settle_ms if same else None)


def test_what_the_rigs_file_says_counts_more(tmp_path: Path) -> None:
    shelf = shelf_with_bench(tmp_path, "size: 64x48, refresh_hz: 60, settle_ms: 17")
    measured(0.02, refresh_hz=60.0).keep(shelf.folder, "bench")
    assert settle_ms(shelf) == 17


@pytest.mark.parametrize("text", ["", "[]", '{"size": [64, 48], "refresh_hz": 60}'])
def test_a_file_that_says_no_latency_is_passed_over(text: str, tmp_path: Path) -> None:
    shelf = shelf_with_bench(tmp_path, "size: 64x48, refresh_hz: 60")
    (tmp_path / "bench.latency.json").write_text(text)
    assert settle_ms(shelf) is None


def test_the_next_rig_of_that_name_has_no_latency(tmp_path: Path) -> None:
    shelf = shelf_with_bench(tmp_path, "size: 64x48")
    measured(0.02, refresh_hz=60.0).keep(shelf.folder, "bench")
    shelf.remove("bench")
    assert settle_ms(shelf_with_bench(tmp_path, "size: 64x48")) is None


class FreeCamera(Camera):
    """Exposes by its own clock, hands a frame over when it is read out, keeps a few; its rows are exposed in turn."""

    capabilities = CameraCapabilities(
        (32, 24), ("Mono8",), Range(1000, 1e6), Range(0, 0), (TriggerSource.FREE_RUN,),
        buffered_frames=2,
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        screen: LaggingScreen,
        *,
        frame_s: float = 1 / 30,
        readout_s: float = 0.012,
        longest_us: float = 1e6,
    ) -> None:
        super().__init__(name, screen)
        self.capabilities = replace(
            self.capabilities, exposure_us=Range(min(1000.0, longest_us), longest_us)
        )
        self._frame_s, self._readout_s = frame_s, readout_s
        self._number = 0

    def configure(self, settings: CameraSettings) -> CameraSettings:
        assert settings.exposure_us in self.capabilities.exposure_us
        return super().configure(settings)

    def trigger(self) -> None:
        raise AssertionError("it can't be triggered")

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        clock, exposure_s = self._screen.clock, self.settings.exposure_us * 1e-6
        arrived = (clock.now_s() - 100.0 - self._readout_s) / self._frame_s
        oldest = int(arrived) - self.capabilities.buffered_frames
        self._number = max(self._number + 1, oldest)
        end_s = 100.0 + self._number * self._frame_s
        clock.sleep(max(0.0, end_s + self._readout_s - clock.now_s()))
        self._light = self._screen.light(end_s - exposure_s, end_s)
        return super().get_frame()


def free_run(lag_s: float, *cameras: str, **camera: float) -> latency.Latency:
    clock = VirtualTime()
    screen = LaggingScreen(lag_s, clock, refresh_hz=60.0)
    made = [FreeCamera(name, screen, **camera) for name in cameras or ("left",)]
    return latency.latency_of(screen, made, _silent, repetitions=10, clock=clock)


@pytest.mark.parametrize("lag_ms", [0.0, 20.0, 60.0])
@pytest.mark.parametrize("frame_s", [1 / 30, 1 / 24.7])
def test_cameras_that_run_freely_find_the_lag_to_within_a_frame_and_what_readout_takes(
    lag_ms: float, frame_s: float
) -> None:
    found = free_run(lag_ms / 1000.0, "left", "right", frame_s=frame_s)
    over_ms = found.settle_ms - 1000 / 60
    assert lag_ms <= over_ms <= lag_ms + 1000 * frame_s + 12.0 + 1000 / 120 + 0.1
    assert found.resolution_ms == pytest.approx(1000 * frame_s + 1000 / 120)
    assert found.by_free_run
    assert found.up[-1] > 0.98
    assert found.down[-1] > 0.98
    assert len(found.up) == len(found.down) == len(found.delays_ms)


def test_a_fixed_exposure_shorter_than_a_period_is_taken_as_it_is() -> None:
    found = free_run(0.02, longest_us=5000.0)
    assert found.exposure_ms == 5.0
    assert found.settle_ms >= 20.0 + 1000 / 60


def test_an_exposure_that_the_rig_file_exaggerates_does_not_shorten_the_latency() -> None:
    class Boasting(FreeCamera):
        """Says that it exposes for a second, at 30 frames a second."""

        def get_frame(self, timeout_s: float = 2.0) -> Frame:
            told, self.settings = self.settings, CameraSettings(10_000.0)
            frame = super().get_frame()
            self.settings = told
            return frame

    clock = VirtualTime()
    screen = LaggingScreen(0.06, clock, refresh_hz=60.0)
    camera = Boasting("left", screen)
    camera.capabilities = replace(camera.capabilities, exposure_us=Range(1e6, 1e6))
    found = latency.latency_of(screen, [camera], _silent, repetitions=10, clock=clock)
    assert found.settle_ms >= 60.0 + 1000 / 60


def test_frames_that_come_without_time_going_on_end_the_search() -> None:
    class File(FreeCamera):
        """Plays pictures as fast as they are fetched."""

        def get_frame(self, timeout_s: float = 2.0) -> Frame:
            self._light = self._screen.changes[-1][1] if len(self._screen.changes) < 4 else 0.0
            return Camera.get_frame(self)

    clock = VirtualTime()
    screen = LaggingScreen(0.0, clock)
    with pytest.raises(StageFailedError, match="doesn't settle within 400 ms"):
        latency.latency_of(screen, [File("left", screen)], _silent, repetitions=3, clock=clock)


def test_where_one_camera_can_be_triggered_it_measures_alone() -> None:
    clock = VirtualTime()
    screen = LaggingScreen(0.02, clock)
    cameras = [FreeCamera("left", screen), Camera("right", screen)]
    found = latency.latency_of(screen, cameras, _silent, repetitions=10, clock=clock)
    assert (found.settle_ms, found.by_free_run) == (measured(0.02).settle_ms, False)
    assert found.resolution_ms == pytest.approx(1000 * PERIOD_S / 2)
