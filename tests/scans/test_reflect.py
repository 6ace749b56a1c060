"""`unglare reflect` and imports of SOFAST measurements: files that come out, figures, and refusals."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from backend.cli.application import run
from backend.domain.states import StageStatus
from tests.scans.houses import real_house, run_unattended, stage_of
from tests.sofast_files import CORNERS_M, FOCAL_M, SIZE, measurement, write_hdf5, write_npz

Reflect = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def reflect(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch) -> Reflect:
    """Run the command with a data folder of the test's own; return status and answer."""
    monkeypatch.setenv("UNGLARE_DATA_FOLDER", str(tmp_path / "data"))

    def command(*arguments: object) -> tuple[int, dict[str, Any]]:
        status = run(["reflect", *map(str, arguments), "--json", "--quiet"])
        answer: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
        return status, answer

    return command


def expect_the_facet(answer: dict[str, Any]) -> None:
    assert answer["focal_lengths_m"] == pytest.approx(FOCAL_M, rel=0.01)
    half = np.abs(CORNERS_M[:2, 0]) / np.sqrt(3) / (2 * np.array(FOCAL_M)) * 1e3
    assert answer["rms_slopes_mrad"] == pytest.approx(half, rel=0.02)


def test_a_measurement_becomes_files_and_figures(reflect, tmp_path):
    out = tmp_path / "out"
    status, answer = reflect(write_npz(tmp_path / "facet.npz"), "--out", out)
    assert status == 0, answer
    expect_the_facet(answer)
    assert answer["bad_frames"] == []
    assert set(answer["ripple_mrad"]["x"]) == {"0.9", "3.9", "15.9"}
    assert answer["time_s"] > 0
    result = np.load(out / "result.npz")
    height, width = SIZE[::-1]
    mask = result["mask"]
    assert result["frac_x"].shape == result["frac_y"].shape == (height, width)
    assert result["wrapped_x"].shape == result["wrapped_y"].shape == (3, height, width)
    assert result["slopes"].shape == (2, mask.sum())
    assert result["surf_coefs"][[2, 5]] == pytest.approx(0.25 / np.array(FOCAL_M), rel=0.01)
    assert np.isfinite(result["frac_x"][mask]).mean() > 0.99
    assert np.isnan(result["frac_x"][~mask]).all()
    frames = measurement()["fringe_images"].astype(float)
    for name, first in (("wrapped_y", 0), ("wrapped_x", 12)):
        i = frames[first + 4 : first + 8]
        expected = np.arctan2(i[1] - i[3], i[0] - i[2])
        assert np.allclose(result[name][1][mask], expected[mask], atol=1e-5)
    # Positions are SOFAST's fractions: x = phase, y = 1 - phase.
    phase = result["wrapped_y"][2] / (2 * np.pi)
    cycles = 15.9 * (1 - result["frac_y"]) - phase
    assert np.abs(cycles - np.rint(cycles))[mask & np.isfinite(cycles)].max() < 1e-3


def test_all_exports_say_the_same(reflect, tmp_path):
    out = tmp_path / "out"
    reflect(write_npz(tmp_path / "facet.npz"), "--out", out)
    table = np.genfromtxt(out / "surface.csv", delimiter=",", names=True)
    with h5py.File(out / "surface.h5") as file:
        height = file["maps/height"][()]
        assert file["maps/height"].attrs["unit"] == "mm"
        assert file["surface/coefficients_m"][()].size == 6
    column, row = table["pixel_x"].astype(int), table["pixel_y"].astype(int)
    assert table.size == np.isfinite(height).sum()
    assert np.allclose(table["z_mm"], height[row, column], atol=1e-5)
    assert (out / "cloud.ply").read_bytes().startswith(b"ply")
    for name in ("modulation.png", "defects.png"):
        picture = cv2.imread(str(out / name), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        assert picture.shape == SIZE[::-1]
    assert json.loads((out / "summary.json").read_text())["valid_share"] > 0.99


def test_hdf5_files_and_folders_are_the_same_measurement(reflect, tmp_path):
    whole = write_hdf5(tmp_path / "whole.h5")
    corners = json.dumps((1e3 * CORNERS_M[:2].T).tolist())
    status, answer = reflect(
        whole, "--out", tmp_path / "one", "--set", f"slopes.outline_mm={corners}"
    )
    assert status == 0, answer
    expect_the_facet(answer)
    folder = tmp_path / "parts"
    folder.mkdir()
    names = (
        ("fringe_images", "mask_images", "fringe_periods_x", "fringe_periods_y", "dist_optic_screen", "v_measure_point_facet"),
        ("camera_matrix", "distortion", "image_shape_xy"),
        ("display_fraction_xy", "display_xyz_m"),
        ("r_cam_screen", "v_cam_screen_cam"),
    )  # fmt: skip
    for number, some in enumerate(names):
        write_hdf5(folder / f"{number}.h5", some)
    # No pose of the mirror this time: its outline tells it.
    status, answer = reflect(
        folder, "--out", tmp_path / "two", "--set", f"slopes.outline_mm={corners}"
    )
    assert status == 0, answer
    assert answer["pose_from"] == "outline"
    expect_the_facet(answer)


def test_a_defective_frame_is_named_left_out_and_told(reflect, tmp_path):
    frames = measurement()["fringe_images"]
    frames[17] = (0.7 * frames[17]).astype(np.uint8)
    status, answer = reflect(
        write_npz(tmp_path / "f.npz", fringe_images=frames), "--out", tmp_path / "out"
    )
    assert status == 0, answer
    assert answer["bad_frames"] == answer["left_out"] == [17]
    assert any("frame 17 of the 3.9 periods along x" in sentence for sentence in answer["findings"])
    assert np.load(tmp_path / "out" / "result.npz")["bad_frames"].tolist() == [17]
    expect_the_facet(answer)


def nan_grid() -> dict[str, Any]:
    grid = measurement()["display_xyz_m"].copy()
    grid[1, 3] = np.nan
    return {"display_xyz_m": grid}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fringe_images": measurement()["fringe_images"][:-1]}, "23 fringe frames, but 3 period counts along y and 3 along x in 4 steps are 24: 1 are missing"),
        ({"fringe_images": None}, "lacks fringe_images"),
        ({"mask_images": None}, "lacks mask_images"),
        ({"fringe_periods_x": None}, "lacks fringe_periods_x"),
        ({"mask_images": measurement()["mask_images"][:1]}, "a dark and a light picture"),
        ({"fringe_images": measurement()["fringe_images"].astype(float)}, "pictures of uint8 or uint16 are needed"),
        (nan_grid(), "1 of 105 numbers that aren't finite"),
        ({"r_cam_screen": np.zeros(2)}, "r_cam_screen holds 2 numbers where 3 are needed"),
        ({"camera_matrix": np.zeros((3, 3))}, "positive focal lengths"),
    ],
)  # fmt: skip
def test_what_is_no_whole_measurement_is_refused_in_one_sentence(reflect, tmp_path, changes, words):
    status, answer = reflect(write_npz(tmp_path / "f.npz", **changes), "--out", tmp_path / "out")
    assert status == 1
    assert words in answer["error"]
    assert answer["error"].count(". ") == 0


def test_files_of_another_kind_are_refused(reflect, tmp_path):
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    assert (
        "can't be read as a SOFAST measurement"
        in reflect(text, "--out", tmp_path / "out")[1]["error"]
    )
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["something"] = 1
    assert "lacks fringe_images" in reflect(other, "--out", tmp_path / "out")[1]["error"]
    assert (
        "There is no file" in reflect(tmp_path / "none.npz", "--out", tmp_path / "out")[1]["error"]
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fringe_periods_x": np.array([2.9, 3.9, 15.9])}, "can't be unwrapped: the coarsest has 2.9 periods"),
        ({"pose_v_cam_optic_cam": np.array([0.0, 0.0, -5.0])}, "meet the mirror's surface"),
        ({"pose_r_cam_optic": None, "facet_corners_m": None}, "Nothing says where the mirror is"),
    ],
)  # fmt: skip
def test_a_measurement_without_slopes_says_why_and_keeps_its_phases(
    reflect, tmp_path, changes, words
):
    status, answer = reflect(write_npz(tmp_path / "f.npz", **changes), "--out", tmp_path / "out")
    assert status == 1
    assert words in answer["error"], answer["error"]
    assert "slopes" not in np.load(tmp_path / "out" / "result.npz")


def test_a_mirror_outside_the_view_is_refused(reflect, tmp_path):
    changes = {"mask_images": np.zeros((2, 90, 120), np.uint8)}
    status, answer = reflect(write_npz(tmp_path / "f.npz", **changes), "--out", tmp_path / "out")
    assert status == 1
    assert (
        "sees no pixel of a mirror with the screen in it: move the mirror into view"
        in answer["error"]
    )


def test_a_measurement_is_reviewable_from_the_fringes_on(tmp_path):
    with real_house(tmp_path) as services:
        imported = services.import_capture(str(write_npz(tmp_path / "f.npz")), "", "test")
        assert imported.name == "a facet"
        assert stage_of(imported, "stack").status is StageStatus.UNAVAILABLE
        assert stage_of(imported, "reflect_capture").status is StageStatus.GIVEN
        state = run_unattended(services, imported.id)
        assert stage_of(state, "mirror_cloud").status is StageStatus.DONE
        files = services.export(imported.id, str(tmp_path / "out"), True, "test")
        assert {"result.npz", "surface.h5", "cloud.ply"} <= {f.name for f in files}
        again = services.import_capture(str(tmp_path / "out"), "", "test")
        replayed = run_unattended(services, again.id)
    for name in ("screen_phase", "slopes", "surface", "mirror_cloud"):
        assert stage_of(replayed, name).result_hash == stage_of(state, name).result_hash


def test_a_zipped_measurement_is_unpacked_like_a_capture(tmp_path):
    from backend.api.uploads import unpack

    archive, folder = tmp_path / "facet.npz", tmp_path / "unpacked"
    write_npz(archive)
    folder.mkdir()
    assert unpack(archive, folder, 2**30) == folder
    wrapped = io.BytesIO()
    with zipfile.ZipFile(wrapped, "w") as zipped:
        zipped.write(archive, "facet.npz")
    (tmp_path / "wrapped.zip").write_bytes(wrapped.getvalue())
    other = tmp_path / "other"
    other.mkdir()
    assert unpack(tmp_path / "wrapped.zip", other, 2**30) == other
    with real_house(tmp_path / "house") as services:
        for place in (folder, other):
            assert services.import_capture(str(place), "", "test").name == "a facet"
