"""Arrays that an operator hands over: a setting names them, a stage loads them, exports carry them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from backend.contract.requests import CreateScan
from backend.domain.errors import InvalidCaptureError, InvalidSettingError
from tests.scans.toy import HEIGHT_PX, WIDTH_PX
from tests.scans.toy_house import House, data_folder, hashes, inline_house, stage

HALF = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
HALF[:, : WIDTH_PX // 2] = 1.0


@pytest.fixture
def other_house(tmp_path: Path) -> Iterator[House]:
    with inline_house(*data_folder(tmp_path / "elsewhere")) as house:
        yield house


@pytest.fixture
def painted(house: House) -> str:
    mask = house.shop.store.put(HALF).hash
    state = house.create(settings={"toy_levels": {"mask": mask, "step_gray": 16}})
    return house.run_through(state.id).id


def labels(house: House, scan: str) -> np.ndarray:
    (field,) = [
        f for f in stage(house.services.scan(scan), "toy_levels").fields if f.name == "labels"
    ]
    return house.services.artifact(field.arrays[""].hash)


def test_a_stage_loads_the_array_that_its_setting_names(house: House, painted: str) -> None:
    assert not labels(house, painted)[:, WIDTH_PX // 2 :].any()
    assert labels(house, painted)[:, : WIDTH_PX // 2].any()


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("ab" * 32, r"toy_levels.mask names the array abababababab\.\.\., which isn't stored here"),
        ("mask.png", "toy_levels.mask can't be 'mask.png'"),
    ],
    ids=["unknown", "no hash"],
)
def test_what_is_not_stored_is_refused_at_once(house: House, value: str, sentence: str) -> None:
    state = house.create()
    with pytest.raises(InvalidSettingError, match=sentence):
        house.edit(state, "toy_levels", mask=value)
    with pytest.raises(InvalidSettingError, match=sentence):
        house.services.create_scan(
            CreateScan(method="toy", rig="toy", settings={"toy_levels": {"mask": value}}), "ada"
        )


def test_an_export_carries_its_arrays_and_comes_back(
    house: House, other_house: House, painted: str, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    house.services.export(painted, str(folder), True, "ada")
    assert [np.array_equal(np.load(p), HALF) for p in (folder / "arrays").iterdir()] == [True]
    imported = other_house.services.import_capture(str(folder), "", "bob")
    state = other_house.run_through(imported.id)
    assert hashes(state) == hashes(house.services.scan(painted))


def test_replays_have_the_arrays(house: House, painted: str, tmp_path: Path) -> None:
    assert house.services.replay(painted).is_same
    house.services.export(painted, str(tmp_path / "out"), True, "ada")
    assert house.services.replay_folder(str(tmp_path / "out")).is_same


def test_a_changed_array_in_an_export_is_refused(
    house: House, other_house: House, painted: str, tmp_path: Path
) -> None:
    house.services.export(painted, str(tmp_path / "out"), True, "ada")
    (file,) = (tmp_path / "out" / "arrays").iterdir()
    np.save(file, 1 - HALF)
    with pytest.raises(InvalidCaptureError, match="isn't what was exported"):
        other_house.services.import_capture(str(tmp_path / "out"), "", "bob")
