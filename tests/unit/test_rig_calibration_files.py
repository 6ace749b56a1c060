"""Calibrations that were made elsewhere: OpenCV's files, captures, and where a rig's is kept."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from backend.cli.application import run
from backend.devices import calibration_entries
from backend.devices.calibration_entries import CalibrationEntry, PoseEntry
from backend.devices.errors import RigConfigError
from backend.devices.pages import PageDesk
from backend.devices.rig_file import RigFile
from backend.devices.rig_shelf import RigShelf
from backend.devices.rig_templates import TEMPLATES
from backend.domain.errors import InvalidCalibrationError
from backend.services.rig_calibration import StereoHints, in_frame_of, read_calibration

SIZE = (1280, 1024)
K = np.array([[2432.0, 0, 640.9], [0, 2430.0, 476.9], [0, 0, 1]])
DISTORTION = np.array([[-0.06, 0.04, 0.0003, -0.0002, 0.01]])
R = np.asarray(cv2.Rodrigues(np.array([0.02, 0.25, -0.01]))[0])
T_MM = np.array([[-178.5], [1.5], [23.0]])
WHOLE: dict[str, Any] = {
    "K1": K,
    "D1": DISTORTION,
    "K2": K,
    "D2": DISTORTION,
    "R": R,
    "T": T_MM,
    "imageSize": SIZE,
}
HINTS = StereoHints(("left", "right"))
BENCH = """
cameras:
  left: {driver: aravis, address: 192.0.2.2}
  right: {driver: aravis, address: 192.0.2.3}
projector: {driver: page, size: 64x48}
"""


def stored(path: Path, entries: dict[str, Any]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        if isinstance(value, tuple):
            storage.startWriteStruct(name, cv2.FileNode_SEQ)
            for number in value:
                storage.write("", number)
            storage.endWriteStruct()
        else:
            storage.write(name, value)
    storage.release()
    return path


def projected(entry: CalibrationEntry, camera: str, points_mm: np.ndarray) -> np.ndarray:
    view = entry.cameras[camera]
    pose = view.device_from_world
    seen, _ = cv2.projectPoints(points_mm, pose.R, pose.t_mm, view.model.K, view.model.distortion)
    return np.asarray(seen)


NAMES = {
    "Python's examples": {},
    "OpenCV's stereo_calib": {"K1": "M1", "K2": "M2"},
    "long names": {"K1": "cameraMatrix1", "K2": "cameraMatrix2", "D1": "distCoeffs1", "D2": "distCoeffs2"},
    "sides": {"K1": "K_left", "K2": "K_right", "D1": "D_left", "D2": "D_right", "imageSize": "image_size"},
}  # fmt: skip


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_points_are_seen_where_opencv_sees_them(
    tmp_path: Path, names: dict[str, str], suffix: str
) -> None:
    file = stored(tmp_path / f"stereo.{suffix}", {names.get(n, n): v for n, v in WHOLE.items()})
    entry = read_calibration([file], HINTS)
    points_mm = np.random.default_rng(0).uniform((-100, -80, 550), (100, 80, 650), (20, 3))
    expected, _ = cv2.projectPoints(points_mm, R, T_MM, K, DISTORTION)
    np.testing.assert_allclose(projected(entry, "right", points_mm), expected, atol=1e-6)
    assert (entry.cameras["left"].width_px, entry.cameras["left"].height_px) == SIZE


def test_intrinsics_and_extrinsics_may_stand_in_two_files(tmp_path: Path) -> None:
    inner = stored(tmp_path / "intrinsics.yml", {n: WHOLE[n] for n in ("K1", "D1", "K2", "D2")})
    outer = stored(tmp_path / "extrinsics.yml", {"R": cv2.Rodrigues(R)[0], "T": T_MM / 1000})
    entry = read_calibration([inner, outer], StereoHints(("left", "right"), 1000.0, SIZE))
    np.testing.assert_allclose(entry.cameras["right"].t_mm, T_MM.ravel(), atol=1e-9)
    np.testing.assert_allclose(entry.cameras["right"].R, R, atol=1e-9)


PROJECTORS: dict[str, dict[str, Any]] = {
    "scan3d-capture": {"cam_K": K, "cam_kc": DISTORTION, "proj_K": K, "proj_kc": DISTORTION, "R": R, "T": T_MM},
    "SLStudio": {"Kc": K, "kc": DISTORTION, "Kp": K, "kp": DISTORTION, "Rp": R, "Tp": T_MM, "frameWidth": 1280, "frameHeight": 1024, "screenResX": 0, "screenResY": 0},
    "procam-calibration": {"img_shape": (1024, 1280), "cam_int": K, "cam_dist": DISTORTION, "proj_int": K, "proj_dist": DISTORTION, "roration": R, "translation": T_MM},
}  # fmt: skip


@pytest.mark.parametrize("content", PROJECTORS.values(), ids=PROJECTORS)
def test_a_projector_calibrated_with_a_camera_is_where_opencv_has_it(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    size = SIZE if "cam_K" in content else None
    hints = StereoHints(("left",), size=size, projector_size=(912, 1140))
    entry = read_calibration([stored(tmp_path / "s.yml", content)], hints)
    assert entry.projector is not None
    assert (entry.projector.width_px, entry.projector.height_px) == (912, 1140)
    assert (entry.cameras["left"].width_px, entry.cameras["left"].height_px) == SIZE
    as_camera = CalibrationEntry(cameras={"projector": entry.projector})
    points_mm = np.random.default_rng(0).uniform((-100, -80, 550), (100, 80, 650), (20, 3))
    expected, _ = cv2.projectPoints(points_mm, R, T_MM, K, DISTORTION)
    np.testing.assert_allclose(projected(as_camera, "projector", points_mm), expected, atol=1e-6)


def test_a_projector_is_added_to_two_cameras_by_the_one_that_saw_it(tmp_path: Path) -> None:
    stereo = in_frame_of(read_calibration([stored(tmp_path / "s.yml", WHOLE)], HINTS), "left")
    file = stored(tmp_path / "p.yml", PROJECTORS["scan3d-capture"])
    hints = StereoHints(("right", "left"), projector_size=(64, 48))
    both = read_calibration([file], hints, stereo)
    assert both.cameras == stereo.cameras
    assert both.projector is not None
    np.testing.assert_allclose(both.projector.R, R @ R, atol=1e-9)
    np.testing.assert_allclose(both.projector.t_mm, (R @ T_MM + T_MM).ravel(), atol=1e-9)
    with pytest.raises(InvalidCalibrationError, match="projector's size is missing"):
        read_calibration([file], StereoHints(("right",)), stereo)


SCREEN = "screen: {width_px: 64, height_px: 48, pixel_pitch_mm: 0.5, R: [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], t_mm: [0, -9, 400]}"


def test_the_example_of_the_description_is_a_calibration() -> None:
    """Its rotation has three digits, as somebody types it."""
    example = (calibration_entries.__doc__ or "").split("::\n")[1].split("\n\nEvery pose")[0]
    entry = CalibrationEntry.model_validate(yaml.safe_load(example)["calibration"])
    assert entry.screen is not None
    pose = entry.screen.device_from_world
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose.R[1], [0, np.cos(np.pi / 6), 0.5], atol=5e-4)


def test_the_rotation_of_a_program_stays_to_the_last_bit() -> None:
    entry = {"R": (R + 1e-9).tolist(), "t_mm": [0.0, 0.0, 0.0]}
    assert PoseEntry.model_validate(entry).R == tuple(map(tuple, entry["R"]))


def test_a_screen_is_added_to_a_camera(tmp_path: Path) -> None:
    lone = stored(tmp_path / "camera.yml", {"camera_matrix": K, "distortion_coefficients": DISTORTION, "image_width": 1280, "image_height": 1024})  # fmt: skip
    part = tmp_path / "screen.yaml"
    part.write_text(SCREEN)
    hints = StereoHints(("camera",))
    entry = read_calibration([lone, part], hints)
    assert read_calibration([part], hints, read_calibration([lone], hints)) == entry
    assert entry.screen is not None
    corners = dict(zip(map(tuple, entry.screen.model.shares), entry.screen.model.points_mm, strict=True))  # fmt: skip
    np.testing.assert_allclose(corners[0.0, 1.0], (-16.0, 12.0, 0.0))
    with pytest.raises(InvalidCalibrationError, match=r"no camera in .*screen\.yaml"):
        read_calibration([part], hints)


@pytest.mark.parametrize("frame", ["left", "right"])
def test_screen_and_mirror_stay_where_they_are_seen(tmp_path: Path, frame: str) -> None:
    stereo = read_calibration([stored(tmp_path / "s.yml", WHOLE)], HINTS)
    held = {"R": R.tolist(), "t_mm": [1.0, 2.0, 500.0]}
    screen = yaml.safe_load(SCREEN)["screen"]
    entry = CalibrationEntry.model_validate({**stereo.model_dump(), "mirror": held, "screen": screen})  # fmt: skip
    turned = in_frame_of(entry, frame)
    assert turned.screen is not None
    assert turned.mirror is not None
    assert entry.screen is not None
    for part, before in ((turned.screen, entry.screen), (turned.mirror, entry.mirror)):
        assert before is not None
        middle_mm = -np.array(before.R).T @ before.t_mm
        seen = entry.cameras[frame]
        expected = np.array(seen.R) @ middle_mm + seen.t_mm
        np.testing.assert_allclose(-np.array(part.R).T @ part.t_mm, expected, atol=1e-9)


def test_the_second_camera_may_be_the_reference(tmp_path: Path) -> None:
    entry = read_calibration([stored(tmp_path / "s.yml", WHOLE)], HINTS)
    turned = in_frame_of(entry, "right")
    np.testing.assert_allclose(turned.cameras["right"].t_mm, np.zeros(3), atol=1e-9)
    points_mm = np.array([[0.0, 0.0, 600.0], [50.0, -20.0, 640.0]])
    in_right_mm = points_mm @ R.T + T_MM.T
    np.testing.assert_allclose(
        projected(turned, "left", in_right_mm), projected(entry, "left", points_mm), atol=1e-6
    )


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"R": None}, r"rotation between the cameras is missing .*looked for R, rotation.*there is K1, D1, K2, D2, T"),
        ({"K2": None}, "camera matrix of right is missing"),
        ({"imageSize": None}, "size of the pictures is missing .*--size 1280x1024"),
        ({"T": T_MM / 1000}, r"0\.18 mm apart with T's unit of 1 mm: say the right one, e\.g\. --unit-mm 1000"),
        ({"R": 2 * R}, "is no rotation: calibrate again"),
        ({"T": np.zeros((2, 1))}, "T has 2 numbers instead of 3"),
        ({"K1": -K}, "positive focal lengths"),
        ({"imageSize": (640, 480)}, "principal point of left is 641, 477 and so outside of 640x480 px: check --size"),
    ],
)  # fmt: skip
def test_what_is_missing_or_impossible_is_one_sentence(
    tmp_path: Path, changes: dict[str, Any], sentence: str
) -> None:
    entries = {name: value for name, value in {**WHOLE, **changes}.items() if value is not None}
    with pytest.raises(InvalidCalibrationError, match=sentence) as refused:
        read_calibration([stored(tmp_path / "s.yml", entries)], HINTS)
    assert "\n" not in str(refused.value)


def test_a_capture_brings_its_calibration(tmp_path: Path) -> None:
    device = {
        "width_px": 1280,
        "height_px": 1024,
        "K": K.tolist(),
        "distortion": DISTORTION.ravel().tolist(),
    }
    link = {
        "kind": "stereo",
        "from": "left",
        "to": "right",
        "R": R.tolist(),
        "t_mm": T_MM.ravel().tolist(),
    }
    frame = {
        "file": "a.png",
        "camera": "left",
        "exposure_ms": 1.0,
        "pattern": {"kind": "uniform", "gray": 255},
    }
    document = {
        "format": "unglare-capture", "version": 1, "name": "a", "method": "hdr-fringe",
        "cameras": {"left": device, "right": device}, "extrinsics": [link], "frames": [frame],
    }  # fmt: skip
    file = tmp_path / "capture.json"
    file.write_text(json.dumps(document))
    entry = read_calibration([file], HINTS)
    np.testing.assert_allclose(entry.cameras["right"].t_mm, T_MM.ravel())
    document["extrinsics"] = []
    file.write_text(json.dumps(document))
    with pytest.raises(InvalidCalibrationError, match="ties no two devices together"):
        read_calibration([file], HINTS)


@pytest.fixture
def shelf(tmp_path: Path) -> RigShelf:
    return RigShelf(tmp_path / "rigs", PageDesk())


def test_a_file_that_the_rig_file_names_is_kept_beside_it(tmp_path: Path, shelf: RigShelf) -> None:
    entry = read_calibration([stored(tmp_path / "s.yml", WHOLE)], HINTS)
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(entry.model_dump(mode="json")))
    (tmp_path / "bench.yaml").write_text(
        BENCH + "calibration: stereo.yaml  # of Monday\n# the end\n"
    )
    kept = shelf.add(tmp_path / "bench.yaml")
    assert kept.path.read_text().endswith("# calibration: see bench.calibration.yaml\n# the end\n")
    calibration = shelf.open("bench", {}).calibration()
    assert calibration is not None
    np.testing.assert_allclose(calibration.camera_from_world["right"].t_mm, T_MM.ravel())
    assert [rig.name for rig in shelf.kept()] == ["bench"]
    shelf.remove("bench")
    (tmp_path / "bench.yaml").write_text(BENCH)
    shelf.add(tmp_path / "bench.yaml")
    assert shelf.open("bench", {}).calibration() is None, "not that of the rig before"


def test_a_calibration_of_other_cameras_is_refused(tmp_path: Path, shelf: RigShelf) -> None:
    (tmp_path / "bench.yaml").write_text(BENCH)
    shelf.add(tmp_path / "bench.yaml")
    entry = read_calibration([stored(tmp_path / "s.yml", WHOLE)], StereoHints(("left", "top")))
    with pytest.raises(RigConfigError, match=r"calibration is for cameras \['left', 'top'\]"):
        shelf.keep_calibration("bench", entry, "s.yml")


@pytest.mark.parametrize("kind", TEMPLATES)
def test_templates_are_rig_files(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["rigs", "template", kind]) == 0
    text = capsys.readouterr().out
    assert "REPLACE" in text
    for comment in ("limits", "gamma", "snap_exposures", "exposure_us", "mirror"):
        text = text.replace(f"# {comment}: ", f"{comment}: ")
    assert RigFile.of(yaml.safe_load(text), kind).title


def test_the_commands_keep_show_and_refuse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bench.yaml").write_text(BENCH)
    stereo = str(stored(tmp_path / "s.yml", WHOLE))
    data = ("--data", str(tmp_path / "data"))

    def unglare(*arguments: str) -> tuple[int, str, str]:
        status = run(["rigs", *arguments, *data])
        return status, *capsys.readouterr()

    assert unglare("add", str(tmp_path / "bench.yaml"))[0] == 0
    assert "not calibrated" in unglare("show", "bench")[1]
    kept = unglare("calibration", "--rig", "bench", stereo, "--cameras", "right,left")
    assert "179.98 mm" in kept[1], kept
    shown = json.loads(unglare("show", "bench", "--json")[1])
    assert shown["rig"]["calibration"]["cameras"]["left"]["t_mm"] == [0, 0, 0], (
        "the reference is the world"
    )
    assert unglare("show", "lost")[2] == "unglare: there is no rig file 'lost'; there are: bench\n"
    refused = unglare("calibration", "--rig", "bench", stereo, "--cameras", "left,top")
    assert (refused[0], refused[2]) == (
        1,
        "unglare: --cameras left,top has to name the rig's cameras: left, right.\n",
    )
