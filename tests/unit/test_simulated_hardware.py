"""Simulated hardware put together: rig files that fit, sentences for what doesn't; nothing is opened or started."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from backend.devices.pages import PageDesk
from backend.devices.peers.monitor_display import MonitorDisplay, MonitorHistory
from backend.devices.peers.simulated_cameras import make_rig
from backend.devices.peers.simulated_light import Ended, Fire
from backend.devices.rig_file import RigFile, assemble
from backend.domain.errors import InvalidSettingError, StartupError
from backend.numerics.screen_surface import screen_surface
from backend.services.simulated_hardware import Hardware, SimulatedHardware, rig_file


@dataclass
class Lamp:
    """A light source that isn't there."""

    size: tuple[int, int] = (640, 400)
    words: str = "a lamp"
    trigger_line: str | None = None
    entry: dict[str, Any] = field(default_factory=lambda: {"driver": "page", "size": "640x400"})

    def run(self, history: MonitorHistory, fire: Fire, ended: Ended) -> None:
        raise AssertionError("never lit")


def hardware(**changes: Any) -> Hardware:
    given = {
        "rig": "simulated",
        "options": {"scene": "plane", "size": "160x120"},
        "addresses": ("127.0.0.2", "127.0.0.3"),
        "light": Lamp(),
    }
    return Hardware(**{**given, **changes})


def written(wanted: Hardware) -> dict[str, Any]:
    history = MonitorHistory(*wanted.light.size)
    try:
        rig = make_rig(wanted.rig, wanted.rig_options, MonitorDisplay(history))
        return rig_file(rig, wanted)
    finally:
        history.destroy()


def test_the_rig_file_has_the_exact_calibration_and_the_true_sensors(tmp_path: Path) -> None:
    wanted = hardware()
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(written(wanted), sort_keys=False))

    read = assemble("lab", RigFile.read(path), PageDesk())

    exact = make_rig("simulated", wanted.rig_options, None).calibration()
    kept = read.calibration()
    assert exact is not None
    assert kept is not None
    assert kept.projector is not None
    assert exact.projector is not None
    for name, model in exact.cameras.items():
        np.testing.assert_array_equal(kept.cameras[name].K, model.K)
        np.testing.assert_array_equal(kept.cameras[name].distortion, model.distortion)
        np.testing.assert_array_equal(
            kept.camera_from_world[name].t_mm, exact.camera_from_world[name].t_mm
        )
    np.testing.assert_array_equal(kept.projector.K, exact.projector.K)
    assert (kept.projector.width_px, kept.projector.height_px) == (640, 400)


def test_a_light_that_triggers_is_wired_and_has_no_model_of_square_pixels() -> None:
    crafted = Lamp(trigger_line="Line1")
    document = written(hardware(light=crafted))
    assert [camera["trigger_line"] for camera in document["cameras"].values()] == ["Line1"] * 2
    assert "projector" not in document["calibration"]


@pytest.mark.parametrize("bow_mm", [0.0, 8.0])
def test_a_screen_and_a_mirror_are_simulated_too(bow_mm: float) -> None:
    options = {"scene": "mirror-flat", "size": "160x120", "screen_bow_mm": bow_mm}
    wanted = hardware(rig="sim-lcd", options=options, addresses=("127.0.0.2",))
    document = written(wanted)
    assert list(document["cameras"]) == ["camera"]
    assert ("pixel_pitch_mm" in document["calibration"]["screen"]) == (bow_mm == 0)

    kept = assemble("lab", RigFile.of(document, "lab"), PageDesk()).calibration()
    exact = make_rig("sim-lcd", wanted.rig_options, None).calibration()
    assert kept is not None
    assert exact is not None
    for name in ("screen_from_world", "mirror_from_world"):
        np.testing.assert_array_equal(getattr(kept, name).R, getattr(exact, name).R)
        np.testing.assert_array_equal(getattr(kept, name).t_mm, getattr(exact, name).t_mm)
    assert kept.screen is not None
    assert exact.screen is not None
    at = np.random.default_rng(0).uniform(0, 1, (50, 2))
    theirs, ours = (screen_surface(s.shares, s.points_mm) for s in (exact.screen, kept.screen))
    np.testing.assert_allclose(ours.points(at), theirs.points(at), atol=1e-9)


def test_another_size_than_the_lights_is_refused() -> None:
    wanted = hardware(options={"projector_size": "1280x800"})
    with pytest.raises(InvalidSettingError, match="projector_size is 1280x800, a lamp is 640x400"):
        wanted.rig_options  # noqa: B018  reading it refuses


def test_cameras_need_as_many_addresses() -> None:
    with pytest.raises(StartupError, match="2 cameras need as many addresses, 1 are given"):
        SimulatedHardware(hardware(addresses=("127.0.0.2",)))
