"""A monitor as light: what was shown when, shared between processes."""

import threading
import time
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.devices.errors import DeviceDisconnected
from backend.devices.peers import monitor_display
from backend.devices.peers.monitor_display import MonitorDisplay, MonitorHistory, watch
from backend.devices.sim import SimulatedRigConfig
from backend.devices.sim.camera import SimulatedCamera
from backend.devices.sim.rig import SimulatedRig

SIZE = (64, 48)


def flat(level: int) -> np.ndarray:
    return np.full(SIZE[::-1], level, np.uint8)


@pytest.fixture
def history() -> Iterator[MonitorHistory]:
    made = MonitorHistory(*SIZE)
    yield made
    made.destroy()


def shown(display: MonitorDisplay, start_s: float, end_s: float) -> list[tuple[int, float]]:
    return [(int(s.pattern[0, 0]), share) for s, share in display.during(start_s, end_s)]


def test_an_exposure_sees_each_frame_for_its_share_of_the_time(history: MonitorHistory) -> None:
    for time_s, level in ((0.0, 10), (1.0, 10), (2.0, 20), (3.0, 20), (4.0, 30)):
        history.note(flat(level), time_s)
    display = MonitorDisplay(history)
    # What changes between two looks changed half way.
    assert shown(display, 0.5, 2.5) == [(10, 0.5), (20, 0.5)]
    assert shown(display, 1.6, 1.9) == [(20, 1.0)]
    assert shown(display, 3.0, 4.0) == [(20, 0.5), (30, 0.5)]


def test_lag_delays_the_light(history: MonitorHistory) -> None:
    for time_s, level in ((0.0, 10), (1.0, 20), (3.0, 20)):
        history.note(flat(level), time_s)
    assert shown(MonitorDisplay(history, lag_s=1.0), 1.0, 2.0) == [(10, 0.5), (20, 0.5)]


def test_equal_frames_are_one_picture_to_whoever_caches_it(history: MonitorHistory) -> None:
    for time_s in (0.0, 1.0, 2.0):
        history.note(flat(7), time_s)
    display = MonitorDisplay(history)
    (first, _), (second, _) = display.during(0.1, 0.9)[0], display.during(1.1, 1.9)[0]
    assert first is second


@given(
    changes=st.lists(st.integers(0, 255), min_size=1, max_size=40),
    start=st.floats(-1.0, 30.0),
    length=st.floats(0.01, 20.0),
)
def test_shares_add_up_and_memory_is_bounded(
    changes: list[int], start: float, length: float
) -> None:
    history = MonitorHistory(*SIZE)
    try:
        for number, level in enumerate(changes):
            history.note(flat(level), float(number))
        history.note(flat(changes[-1]), 100.0)
        parts = MonitorDisplay(history).during(start, start + length)
        assert len(parts) <= monitor_display._KEPT
        assert sum(share for _, share in parts) == pytest.approx(1.0)
    finally:
        history.destroy()


def test_it_waits_until_the_monitor_was_looked_at_after_the_exposure(
    history: MonitorHistory,
) -> None:
    history.note(flat(10), 0.0)
    display = MonitorDisplay(history)
    timer = threading.Timer(0.05, lambda: history.note(flat(10), 5.0))
    timer.start()
    assert shown(display, 3.0, 4.0) == [(10, 1.0)]
    timer.join()


def test_nobody_looking_is_a_sentence(
    history: MonitorHistory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monitor_display, "_PATIENCE_S", 0.05)
    history.note(flat(10), 0.0)
    with pytest.raises(DeviceDisconnected, match="nobody looks at it any more; start again"):
        MonitorDisplay(history).during(1.0, 2.0)


def test_watching_looks_often_and_ends_when_told(history: MonitorHistory) -> None:
    began_s, looks = time.monotonic(), 0

    def ended(left_s: float) -> bool:
        nonlocal looks
        looks += 1
        threading.Event().wait(left_s)
        return looks > 10

    watch(lambda: flat(looks), history, looks_per_s=200.0, ended=ended)
    assert history.looked_s >= began_s
    assert looks == 11


def _last_level(display: MonitorDisplay, told: Connection) -> None:
    told.send(int(display.during(1.0, 2.0)[-1][0].pattern[0, 0]))


def test_another_process_sees_the_same(history: MonitorHistory) -> None:
    history.note(flat(10), 0.0)
    history.note(flat(99), 2.0)
    context = get_context("fork")
    ours, theirs = context.Pipe()
    process = context.Process(target=_last_level, args=(MonitorDisplay(history), theirs))
    process.start()
    assert ours.recv() == 99
    process.join()


def test_a_rig_lit_by_a_monitor_mixes_what_it_showed(history: MonitorHistory) -> None:
    """Half the exposure white, half black: half the light."""
    options = {"scene": "plane", "size": "160x120", "projector_size": f"{SIZE[0]}x{SIZE[1]}"}
    config = SimulatedRigConfig.model_validate(
        {**options, "frame_period_ms": None, "glare_share": 0.0, "ambient_e_per_ms": 0.0}
    )

    def mean(*levels: int) -> float:
        made = MonitorHistory(*SIZE)
        rig = SimulatedRig(config, MonitorDisplay(made))
        try:
            with rig:
                camera = rig.cameras["left"]
                assert isinstance(camera, SimulatedCamera)
                camera.configure(camera.settings)
                camera.arm()
                now_s = time.monotonic()
                made.note(flat(levels[0]), now_s - 1.0)
                camera.trigger()
                start_s = camera._queue[0].start_s
                made.note(flat(levels[0]), start_s)
                # Noted as seen at the exposure's end, so that it changed half way.
                made.note(flat(levels[-1]), start_s + camera.settings.exposure_us * 1e-6)
                return float(camera.get_frame().data.mean()) - config.black_level_gray
        finally:
            made.destroy()

    white, black, half = mean(255), mean(0), mean(255, 0)
    assert half == pytest.approx((white + black) / 2, rel=0.02)
    assert white > 10 * max(black, 0.1)
