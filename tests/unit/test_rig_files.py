"""Rig files: what is in them, what is refused, and how drivers are found."""

from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from backend.devices import driver_loading, plug_ins
from backend.devices.assembled import AssembledRig, SensorFacts
from backend.devices.drivers.aravis_camera import AravisCamera
from backend.devices.drivers.page_projector import PageProjector
from backend.devices.errors import RigConfigError, RigNotFoundError
from backend.devices.pages import PageDesk
from backend.devices.rig_file import RigFile, assemble
from backend.devices.rig_shelf import RigShelf
from backend.devices.sim import create_rig
from backend.devices.whole_files import write_whole

BENCH = """
title: Bench by the window
cameras:
  left:  {driver: aravis, address: 192.0.2.2, sensor: {full_well_e: 10500, read_noise_e: 6.5}}
  right: {driver: aravis, address: 192.0.2.3}
projector: {driver: page, size: 1280x800, refresh_hz: 60, settle_ms: 17, gamma: 2.2}
"""
VIEW = "{width_px: 64, height_px: 48, K: [[60, 0, 32], [0, 60, 24], [0, 0, 1]]%s}"
UNIT = "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]"
CALIBRATED = f"{BENCH}calibration:\n  cameras: {{left: {VIEW % ''}, right: {VIEW}}}\n"
APART = CALIBRATED % ", t_mm: [9, 0, 0]"


@pytest.fixture
def shelf(tmp_path: Path) -> RigShelf:
    return RigShelf(tmp_path / "rigs", PageDesk())


def written(folder: Path, text: str, name: str = "bench.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_rig_is_made_of_its_file(tmp_path: Path, shelf: RigShelf) -> None:
    kept = shelf.add(written(tmp_path, BENCH))
    rig = shelf.open(kept.name, {})
    assert rig.name == "bench"
    assert list(rig.cameras) == ["left", "right"]
    assert all(isinstance(camera, AravisCamera) for camera in rig.cameras.values())
    assert isinstance(rig.projector, PageProjector)
    assert rig.projector.capabilities.size == (1280, 800)
    assert rig.calibration() is None


@pytest.mark.parametrize(
    ("projector", "page"),
    [("page, size: 64x48", "projector"), ("page, page: left", "left"), ("beamer, page: 3", None)],
)
def test_a_file_says_which_page_it_needs(projector: str, page: str | None) -> None:
    driver, _, options = projector.partition(", ")
    name, _, value = options.partition(": ")
    entry = {"driver": driver, name: value}
    cameras = {"left": {"driver": "aravis", "address": "192.0.2.2"}}
    assert RigFile.of({"cameras": cameras, "projector": entry}, "test").page == page


def test_names_of_the_shelf_come_first_and_others_still_open(shelf: RigShelf) -> None:
    assert shelf.kept() == ()
    assert shelf.open("simulated", {"scene": "plane"}).name == "simulated"
    with pytest.raises(RigNotFoundError, match="nowhere"):
        shelf.open("nowhere", {})


def test_a_removed_file_is_renamed(tmp_path: Path, shelf: RigShelf) -> None:
    shelf.add(written(tmp_path, BENCH), "line-2")
    left = shelf.remove("line-2")
    assert left.read_text() == BENCH
    assert shelf.kept() == ()
    with pytest.raises(RigNotFoundError, match="'line-2'"):
        shelf.remove("line-2")


@pytest.mark.parametrize("name", ["simulated", "Bench", "../bench", "a b"])
def test_names_that_are_taken_or_none_are_refused(
    name: str, tmp_path: Path, shelf: RigShelf
) -> None:
    with pytest.raises(RigConfigError, match=name.replace(".", r"\.")):
        shelf.add(written(tmp_path, BENCH), name)
    assert shelf.kept() == ()


def test_an_edited_file_counts_at_once(tmp_path: Path, shelf: RigShelf) -> None:
    kept = shelf.add(written(tmp_path, BENCH))
    kept.path.write_text(BENCH.replace("1280x800", "1920x1080"))
    assert shelf.open("bench", {}).projector.capabilities.size == (1920, 1080)


def test_options_of_a_described_rig_are_refused(tmp_path: Path, shelf: RigShelf) -> None:
    shelf.add(written(tmp_path, BENCH))
    with pytest.raises(RigConfigError, match="takes no options, but got scene"):
        shelf.open("bench", {"scene": "plane"})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("cameras: [", "isn't YAML"),
        ("- 1", "the whole file"),
        ("cameras: {}\nprojector: {driver: page, size: 64x48}", "cameras: "),
        (BENCH.replace("driver: aravis, address: 192.0.2.2", "driver: arvis, address: 192.0.2.2"), "left: there is no driver 'arvis'; choose aravis"),
        (BENCH.replace("address: 192.0.2.3", "adress: 192.0.2.3"), "right: there is no option 'adress'; the options are address"),
        (BENCH.replace(", address: 192.0.2.3", ""), "right: .*give either the address"),
        (BENCH.replace("full_well_e: 10500", "full_well_e: -1"), "cameras.left.sensor.full_well_e"),
        (BENCH.replace("1280x800", "12x8"), "projector: option size can't be '12x8'"),
        (BENCH.replace(" size: 1280x800,", ""), "projector: option size is missing; add it"),
        (BENCH.replace("right:", "../right:"), "'../right' is no name for a camera"),
        (BENCH.replace("right:", "projector:"), "'projector' is no name for a camera"),
        (BENCH + "calibration: {cameras: {left: " + VIEW % ", distortion: [0.1, 0.2, 0.3]" + "}}", "it has 3 coefficients"),
        (BENCH.replace("page,", "beamer,"), "projector: there is no driver 'beamer'; choose page"),
        (BENCH + "calibration: {cameras: {left: " + VIEW % "" + "}}", "calibration is for cameras \\['left'\\], the rig has"),
        (BENCH + "calibration: {cameras: {left: " + VIEW % ", R: [[2, 0, 0], [0, 1, 0], [0, 0, 1]]" + "}}", "no rotation"),
        (CALIBRATED % "", "left and right stand at the same place, so there would be no depth"),
        (f"{APART}  screen: {{R: {UNIT}, t_mm: [0, 0, 1]}}", "calibration.screen: give either pixel_pitch_mm"),
        (f"{APART}  screen: {{R: {UNIT}, t_mm: [0, 0, 1], pixel_pitch_mm: 0.1}}", "with pixel_pitch_mm it needs width_px and height_px"),
        (f"{APART}  screen: {{R: {UNIT}, t_mm: [0, 0, 1], pixel_pitch_mm: 0.00027}}", "pixel_pitch_mm can't be 0.00027: input should be greater"),
        (f"{APART}  screen: {{R: {UNIT}, pixel_pitch_mm: 0.27}}", "calibration.screen.t_mm is missing; add it"),
        (f"{APART}  screen: {{R: {UNIT}, t_mm: [0, 0, 1], points: [[0, 0, 1, 1, 0], [0, 1, 1, 1, 0], [0, 0.5, 3, 3, 3]]}}", "lie on one line of the pattern"),
        (BENCH.replace("192.0.2.3", "192.0.2.2"), r"left and right are the same device \(address 192.0.2.2\): give each its own"),
        (BENCH.replace("right:", "left:"), "isn't YAML \\('left' stands twice in the entry that begins in line 4"),
        (BENCH + "reference: middle", "reference 'middle' is none of its cameras: choose left, right"),
        (BENCH + "projektor: {}", "there is no entry 'projektor'; the entries are title, cameras, reference, projector"),
        (BENCH.replace("read_noise_e", "noise_e"), "no entry 'noise_e' in cameras.left.sensor; the entries are bit_depth"),
        (BENCH.replace("full_well_e: 10500", "full_well_e: much"), "cameras.left.sensor.full_well_e can't be 'much': input should be a valid number"),
        (BENCH.replace("gamma: 2.2", "gamma: 22"), "projector.gamma can't be 22: input should be less than 5"),
        ("cameras: {left: {address: 192.0.2.2}}\nprojector: {driver: page}", "cameras.left.driver is missing; add it"),
        ("cameras: {left: {driver: aravis, address: 192.0.2.2}}", "bench.yaml: projector is missing; add it"),
        (BENCH.replace("192.0.2.3}", "192.0.2.3, trigger_line: Line1}"), "right: trigger_line Line1 has no use, projector driver page has no trigger output"),
        (BENCH.replace("192.0.2.3}", "192.0.2.3, trigger_line: Line9}"), "cameras.right.trigger_line can't be 'Line9'"),
        (BENCH.replace("192.0.2.3}", "192.0.2.3, limits: {longest_exposure: 3}}"), "no entry 'longest_exposure' in cameras.right.limits; the entries are longest_exposure_ms"),
        (BENCH + "calibration: lost.yaml", "calibration .*lost.yaml can't be read \\(No such file"),
    ],
)  # fmt: skip
def test_what_cant_be_used_is_one_sentence(
    text: str, sentence: str, tmp_path: Path, shelf: RigShelf
) -> None:
    with pytest.raises(RigConfigError, match=sentence) as refused:
        shelf.add(written(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_another_camera_may_be_the_reference(tmp_path: Path, shelf: RigShelf) -> None:
    kept = shelf.add(written(tmp_path, BENCH + "reference: right"))
    assert list(shelf.open(kept.name, {}).cameras) == ["right", "left"]


def test_a_missing_file_is_named(tmp_path: Path, shelf: RigShelf) -> None:
    with pytest.raises(RigConfigError, match=r"lost\.yaml can't be read"):
        shelf.add(tmp_path / "lost.yaml")


def test_the_calibration_is_the_first_cameras_frame() -> None:
    file = RigFile.of(
        {
            "cameras": {n: {"driver": "aravis", "address": f"192.0.2.{i}"} for i, n in enumerate("ab")},
            "projector": {"driver": "page", "size": "64x48"},
            "calibration": {
                "cameras": {n: {"width_px": 64, "height_px": 48, "K": np.eye(3).tolist(), "t_mm": t} for n, t in (("a", (0, 0, 0)), ("b", (-180, 0, 0)))},
            },
        },
        "test",
    )  # fmt: skip
    calibration = assemble("test", file, PageDesk()).calibration()
    assert calibration is not None
    assert calibration.reference == "a"
    np.testing.assert_array_equal(calibration.camera_from_world["b"].t_mm, (-180, 0, 0))
    assert calibration.projector is None


def make_broken(name: str, options: dict[str, object]) -> None:
    raise RuntimeError("no licence")


def test_drivers_of_packages_are_found_and_a_broken_one_stops_only_its_rig(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here = [
        EntryPoint("acme", f"{__name__}:make_broken", driver_loading.CAMERAS),
        EntryPoint("gone", "no.such.module:make", driver_loading.CAMERAS),
    ]
    monkeypatch.setattr(
        plug_ins, "entry_points", lambda group: [e for e in here if e.group == group]
    )
    assert driver_loading.available_drivers(driver_loading.CAMERAS)[-2:] == ("acme", "gone")
    with pytest.raises(
        RigConfigError, match="left: driver acme failed with RuntimeError: no licence"
    ):
        driver_loading.make_camera("left", "acme", {})
    with pytest.raises(RigConfigError, match="left: camera gone can't be loaded"):
        driver_loading.make_camera("left", "gone", {})
    assert driver_loading.make_camera("left", "aravis", {"address": "192.0.2.2"}).name == "left"


def test_a_file_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    path = written(tmp_path, "before")
    path.with_name(f".{path.name}.partial").mkdir()
    with pytest.raises(RigConfigError, match="can't be written"):
        write_whole(path, "after")
    assert path.read_text() == "before"


@pytest.mark.parametrize("said", [None, 12])
def test_depth_is_the_cameras(said: int | None) -> None:
    with _twelve_bits(said) as rig:
        assert rig.facts().cameras["left"].bit_depth == 12


def test_another_depth_than_the_cameras_is_refused() -> None:
    with (
        _twelve_bits(8) as rig,
        pytest.raises(RigConfigError, match="left: the camera delivers Mono12, 12 bits"),
    ):
        rig.facts()


@pytest.mark.parametrize("device", ["right", "projector"])
def test_a_calibration_at_another_size_is_refused(device: str) -> None:
    simulated = create_rig({"scene": "plane", "size": "64x48", "projector_size": "80x48"})
    sensors = dict.fromkeys(simulated.cameras, SensorFacts())
    sizes = {"left": (64, 48), "right": (64, 48), "projector": (80, 48), device: (60, 40)}
    rig = AssembledRig("bench", simulated.cameras, simulated.projector, sensors=sensors, calibrated_px=sizes)  # fmt: skip
    with rig, pytest.raises(RigConfigError, match=f"{device}: the calibration is for 60x40 px"):
        rig.facts()


def _twelve_bits(said: int | None) -> AssembledRig:
    simulated = create_rig({"scene": "plane", "size": "64x48", "projector_size": "64x48", "bit_depth": 12})  # fmt: skip
    sensors = dict.fromkeys(simulated.cameras, SensorFacts(said))
    return AssembledRig("bench", simulated.cameras, simulated.projector, sensors=sensors)
