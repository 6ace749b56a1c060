"""What stands behind --set, --rig-option and the sizes."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from backend.cli.options import (
    parse_given,
    parse_rig_options,
    parse_settings,
    parse_value,
    with_uploads,
)
from backend.contract.requests import GivenSource
from backend.domain.errors import InvalidSettingError
from tests.scans.toy_house import House, data_folder, inline_house


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    with inline_house(*data_folder(tmp_path / "data")) as house:
        yield house


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("2.5", 2.5),
        ("-1e-3", -1e-3),
        ("null", None),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ("16.7,100", [16.7, 100]),
        ("50,", [50]),
        ('"3"', "3"),
        ("fast", "fast"),
        ("sprayed:metal", "sprayed:metal"),
        ("a,b", "a,b"),
        ("NaN", "NaN"),
        ("Infinity", "Infinity"),
        ("", ""),
    ],
)
def test_a_value_is_json_a_list_or_text(text, value):
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)


def test_settings_are_sorted_by_stage_and_the_last_one_counts():
    texts = [
        "zones.gap_gray=9",
        "zones.sigma_gray = 2",
        "zones.gap_gray=10",
        "fusion.strategy=masks",
    ]
    assert parse_settings(texts) == {
        "zones": {"gap_gray": 10, "sigma_gray": 2},
        "fusion": {"strategy": "masks"},
    }


def test_a_value_may_hold_equals_signs_and_dots():
    assert parse_settings(["a.b=c=d.e"]) == {"a": {"b": "c=d.e"}}


@pytest.mark.parametrize("text", ["zones", "zones=3", "zones.gap_gray", ".gap=3", "zones.=3", "=3"])
def test_a_setting_of_another_form_is_named(text):
    with pytest.raises(InvalidSettingError, match=r"STAGE\.FIELD=VALUE"):
        parse_settings([text])


def test_results_come_from_a_scan_a_folder_or_a_calibration(tmp_path: Path) -> None:
    texts = ["A=3", f"B={tmp_path}", "C=01m2k8v0q4x9h3tz", "D=none", "E=out/last", "A=4"]
    assert parse_given(texts) == {
        "A": GivenSource(calibration=4),
        "B": GivenSource(folder=str(tmp_path)),
        "C": GivenSource(scan="01m2k8v0q4x9h3tz"),
        "D": None,
        "E": GivenSource(folder=str(Path("out/last").absolute())),
    }


@pytest.mark.parametrize("text", ["Ramp", "=3", "Ramp="])
def test_a_given_result_of_another_form_is_named(text: str) -> None:
    with pytest.raises(InvalidSettingError, match=r"TYPE=SCAN"):
        parse_given([text])


def test_only_options_that_are_given_reach_the_rig():
    assert parse_rig_options(None) == {}
    assert parse_rig_options(["bit_depth=12"], scene="metal", seed=3) == {
        "scene": "metal",
        "seed": 3,
        "bit_depth": 12,
    }


@pytest.mark.parametrize("text", ["bit_depth", "=12"])
def test_a_rig_option_of_another_form_is_named(text):
    with pytest.raises(InvalidSettingError, match="KEY=VALUE"):
        parse_rig_options([text])


HEAVY = {
    "numba",
    "cv2",
    "scipy",
    "open3d",
    "sqlalchemy",
    "fastapi",
    "backend.main",
    "numpy",
    "rich.progress",
}


def test_help_needs_nothing_heavy():
    code = "import sys; from backend.cli.application import run; status = run(['--help']); print(*sys.modules, file=sys.stderr); sys.exit(status)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "rigs" in done.stdout
    assert HEAVY & set(done.stderr.split()) == set()


def test_a_file_takes_the_place_of_an_array(house: House, tmp_path: Path) -> None:
    mask = np.full((2, 3), 0.5, np.float32)
    np.save(tmp_path / "mask.npy", mask)
    given = parse_settings(
        [f"toy_levels.mask={tmp_path / 'mask.npy'}", "toy_levels.colour=mask.npy"]
    )
    settings = with_uploads(house.services, "toy", given)["toy_levels"]
    np.testing.assert_array_equal(house.services.artifact(settings["mask"]), mask)
    assert settings["colour"] == "mask.npy"
    for value in (settings["mask"], None):
        again = {"toy_levels": {"mask": value}}
        assert with_uploads(house.services, "toy", again) == again


def test_a_file_that_is_not_there_is_named(house: House) -> None:
    with pytest.raises(
        InvalidSettingError, match=r"toy_levels.mask=no.png: the file can't be read"
    ):
        with_uploads(house.services, "toy", {"toy_levels": {"mask": "no.png"}})
