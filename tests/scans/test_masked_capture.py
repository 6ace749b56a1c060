"""Shots under an intensity mask are exported with it, and found again in the journal."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pytest

from backend.contract.capture import Capture
from backend.contract.requests import CreateScan
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Frames
from backend.domain.method import Method
from backend.domain.params import Params, setting
from backend.domain.patterns import WHITE
from backend.domain.rig import RigFacts
from backend.domain.shots import Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.jobs.execution import Workshop
from backend.jobs.rigs import RigPool
from backend.jobs.runner import InlineRunner
from backend.methods import Registry
from backend.services.events import EventHub
from backend.services.services import Services
from tests.scans.houses import run_unattended
from tests.scans.toy import PROJECTOR_PX, ToyRigs
from tests.scans.toy_house import data_folder


class MaskedParams(Params):
    """How dark the mask is."""

    factor: float = setting(1 / 3, title="Factor", ge=0, le=1)


@dataclass(frozen=True)
class Masked:
    """White fields without and with the mask."""

    frames: Annotated[tuple[Frame, ...], Frames("Fields")]


@stage(title="Masked", version=1)
def masked(facts: RigFacts, params: MaskedParams, shoot: Shoot) -> Masked:
    """Capture the white field twice without and once with a mask."""
    return shoot(masked_plan(params))


def masked_plan(params: MaskedParams) -> Plan[Masked]:
    width, height = PROJECTOR_PX
    mask = np.linspace(params.factor, 1.0, width * height, dtype=np.float32).reshape(height, width)
    plain = Shot(WHITE, 5.0, role="white")
    exposed = yield (plain, plain, Shot(WHITE, 5.0, role="white", mask=InMemory(mask)))
    return Masked(tuple(frame for shot in exposed for frame in shot.values()))


REGISTRY = Registry({"masked": Method("masked", "Masked", (masked,))})


@contextlib.contextmanager
def services_in(folder: Path) -> Iterator[Services]:
    database, store = data_folder(folder)
    rigs = RigPool(ToyRigs())
    shop = Workshop(
        database, store, rigs, lambda: REGISTRY, lambda event: None, {"unglare": "test"}
    )
    services = Services(
        database=database,
        store=store,
        runner=InlineRunner(shop),
        rigs=rigs,
        registry=REGISTRY,
        events=EventHub(),
        version="test",
    )
    with contextlib.closing(services):
        yield services


@pytest.fixture
def exported(tmp_path: Path) -> tuple[Path, str | None]:
    """Scan, export, and return folder and hash."""
    with services_in(tmp_path / "here") as services:
        scan = services.create_scan(CreateScan(method="masked", rig="toy"), "ada").id
        state = run_unattended(services, scan)
        services.export(scan, str(tmp_path / "out"), True, "ada")
        return tmp_path / "out", state.stages[0].result_hash


def test_the_mask_is_a_picture_for_others(exported):
    folder, _ = exported
    capture = Capture.model_validate_json((folder / "capture.json").read_text())
    masks = {frame.mask for frame in capture.frames}
    (name,) = masks - {None}
    picture = cv2.imread(str(folder / str(name)), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.dtype == np.dtype(np.uint16)
    assert picture.shape == PROJECTOR_PX[::-1]
    assert picture[0, 0] == pytest.approx(65535 / 3, abs=1)
    assert picture[-1, -1] == 65535


def test_shots_under_the_mask_and_repeated_ones_are_found_again(exported, tmp_path):
    folder, expected = exported
    with services_in(tmp_path / "there") as services:
        imported = services.import_capture(str(folder), "", "bob")
        state = run_unattended(services, imported.id)
    assert state.stages[0].result_hash == expected


def test_another_mask_is_another_shot(exported, tmp_path):
    folder, _ = exported
    (mask,) = folder.glob("masks/*.npy")
    np.save(mask, np.load(mask) * np.float32(0.5))
    with services_in(tmp_path / "there") as services:
        imported = services.import_capture(str(folder), "", "bob")
        state = run_unattended(services, imported.id)
    assert state.stages[0].result_hash is None
    assert "lack" in state.stages[0].message
