"""Drivers of packages from outside that aren't what the protocols say: refused by name, and nothing else breaks."""

from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

from backend.devices import driver_loading, plug_ins
from backend.devices.assembled import AssembledRig
from backend.devices.errors import DriverFailed, RigConfigError
from backend.devices.pages import PageDesk
from backend.devices.protocols import LinkState
from backend.devices.rig_file import RigFile, assemble
from backend.jobs.control import JobControl
from backend.jobs.shooting import Shooter
from tests.example_driver.acme_unglare import AcmeCamera, AcmeProjector, Options, create_projector


class CapabilitiesIsAMethod(AcmeCamera):
    def capabilities(self) -> Any:  # type: ignore[override]  # that's the fault
        return 3


class ArmCantBeCalled(AcmeCamera):
    arm = 5  # type: ignore[assignment]  # that's the fault


class ConfigureTakesNothing(AcmeCamera):
    def configure(self) -> Any:  # type: ignore[override]  # that's the fault
        return self.settings


class OpeningFails(AcmeCamera):
    def open(self) -> None:
        raise RuntimeError("SDK says\n-3")


class CapabilitiesAreADictionary(AcmeCamera):
    @property
    def capabilities(self) -> Any:
        return {"size": (32, 24)}


class StateIsAWord(AcmeCamera):
    @property
    def state(self) -> Any:
        return "fine"


class FramesAreTuples(AcmeCamera):
    def get_frame(self, timeout_s: float = 2.0) -> Any:
        return np.zeros((24, 32), np.uint8), timeout_s


class TriggerFails(AcmeCamera):
    def trigger(self) -> None:
        raise ZeroDivisionError("float division by zero")


BENCH: dict[str, Any] = {
    "cameras": {
        "left": {"driver": "wrong", "cell": "wrong", "size": "32x24"},
        "right": {"driver": "video", "source": 0, "exposure_us": 20_000},
    },
    "projector": {"driver": "lamp", "cell": "wrong", "size": "32x20"},
}
make_lamp = create_projector


@pytest.fixture
def rig_with(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[AcmeCamera]], AssembledRig]:
    """Make a rig of a rig file whose camera is one of a package's."""

    def make(kind: type[AcmeCamera]) -> AssembledRig:
        monkeypatch.setitem(
            globals(), "make_wrong", lambda name, options: kind(name, Options(**options))
        )
        here = [
            EntryPoint("wrong", f"{__name__}:make_wrong", driver_loading.CAMERAS),
            EntryPoint("lamp", f"{__name__}:make_lamp", driver_loading.PROJECTORS),
            EntryPoint("aravis", "no.such.module:make", driver_loading.CAMERAS),
        ]
        monkeypatch.setattr(
            plug_ins, "entry_points", lambda group: [e for e in here if e.group == group]
        )
        cameras = {"left": BENCH["cameras"]["left"]}
        file = RigFile.of(BENCH | {"cameras": cameras}, "test")
        return assemble("test", file, PageDesk())

    return make


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (CapabilitiesIsAMethod, "left: driver wrong made a CapabilitiesIsAMethod whose capabilities is a method, not"),
        (ArmCantBeCalled, "whose arm can't be called; see backend.devices.protocols.Camera"),
        (ConfigureTakesNothing, r"whose configure doesn't take \(settings\)"),
    ],
)  # fmt: skip
def test_what_has_not_the_protocols_methods_is_refused_when_it_is_made(
    rig_with: Callable[[type[AcmeCamera]], AssembledRig], kind: type[AcmeCamera], sentence: str
) -> None:
    with pytest.raises(RigConfigError, match=sentence):
        rig_with(kind)


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (OpeningFails, "left: its driver failed in opening with RuntimeError: SDK says -3; see the log"),
        (CapabilitiesAreADictionary, "left: its driver's capabilities is a dict, not a CameraCapabilities"),
        (StateIsAWord, "left: its driver's state is a str, not a LinkState; mend"),
    ],
)  # fmt: skip
def test_what_is_found_out_when_it_is_opened_closes_the_others(
    rig_with: Callable[[type[AcmeCamera]], AssembledRig], kind: type[AcmeCamera], sentence: str
) -> None:
    rig = rig_with(kind)
    with pytest.raises(DriverFailed, match=sentence):
        rig.open()
    assert isinstance(rig.projector, AcmeProjector)
    assert rig.projector.state is LinkState.CLOSED


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (FramesAreTuples, "left: its driver's get_frame returned a tuple, not a Frame"),
        (TriggerFails, "left: its driver failed in taking a picture with ZeroDivisionError: float division by zero"),
    ],
)  # fmt: skip
def test_what_fails_in_a_shot_ends_it_by_name(
    rig_with: Callable[[type[AcmeCamera]], AssembledRig], kind: type[AcmeCamera], sentence: str
) -> None:
    with rig_with(kind) as rig, Shooter(rig, JobControl()) as shooter:
        shooter.load([np.zeros((20, 32), np.uint8)])
        with pytest.raises(DriverFailed, match=sentence):
            shooter.take(0, exposure_ms=5.0, gain_db=0.0, cameras=["left"])


def test_a_package_cannot_take_the_name_of_a_built_in_driver(
    rig_with: Callable[[type[AcmeCamera]], AssembledRig],
) -> None:
    rig_with(AcmeCamera)
    made = driver_loading.make_camera("left", "aravis", {"address": "192.0.2.2"})
    assert type(made).__module__.startswith("backend.")
    names = driver_loading.available_drivers(driver_loading.CAMERAS)
    assert names.count("aravis") == 1
