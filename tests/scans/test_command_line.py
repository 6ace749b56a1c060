"""The commands, run in this process: answers, sentences, exit statuses."""

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend import main
from backend.cli.application import run
from backend.cli.serving import begin_first_scan
from backend.contract.requests import CreateScan
from backend.devices.sim import SimulatedRig
from backend.domain.states import JobStatus
from backend.jobs.runner import JobThreads
from backend.services.ply import read_ply
from backend.storage.database import utc_now
from backend.storage.rows import JobRow
from tests.scans.houses import real_house

SMALL = ("--scene", "plane", "--size", "160x120")

pytestmark = pytest.mark.scan


@dataclass
class Done:
    """What a command did."""

    status: int
    out: str
    err: str
    answer: dict[str, Any] = field(default_factory=dict)


Command = Callable[..., Done]


@pytest.fixture
def unglare(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch) -> Command:
    """Run a command with a data folder of the test's own; with --json the last line is read."""
    monkeypatch.setenv("UNGLARE_DATA_FOLDER", str(tmp_path / "data"))

    def command(*arguments: str) -> Done:
        status = run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        answer = json.loads(out.splitlines()[-1]) if "--json" in arguments else {}
        return Done(status, out, err, answer)

    return command


@dataclass(frozen=True)
class Scanned:
    """A scan that a command has made, and where it has put everything."""

    done: Done
    data: Path
    out: Path


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    """Scan once for all tests that only look at the result."""
    folder = tmp_path_factory.mktemp("scanned")
    data, out = folder / "data", folder / "out"
    places = ["--data", str(data), "--out", str(out)]
    with contextlib.redirect_stdout(io.StringIO()) as said, pytest.MonkeyPatch.context() as patch:
        patch.delenv("UNGLARE_DATA_FOLDER", raising=False)
        status = run(["scan", *SMALL, "--name", "first", "--frames", "--json", *places])
    text = said.getvalue()
    return Scanned(Done(status, text, "", json.loads(text.splitlines()[-1])), data, out)


def test_a_scan_answers_with_one_json_object(scanned):
    done = scanned.done
    assert done.status == 0, done.answer
    assert len(done.out.splitlines()) == 1
    answer = done.answer
    assert answer["status"] == "finished"
    assert "error" not in answer
    names = ["pre_exposure", "zones", "exposures", "fringe_capture", "fusion", "fringe_phase"]
    assert [s["name"] for s in answer["stages"]] == [*names, "stereo_cloud"]
    for stage in answer["stages"]:
        assert stage["status"] == "done"
        assert stage["duration_s"] >= 0
        assert all(check["level"] in ("ok", "warning") for check in stage["checks"])
    assert answer["points"] > 1000
    assert set(answer["truth"]) >= {"completeness", "outlier_share", "rms_mm", "median_mm"}
    assert answer["truth"]["completeness"] > 0.9
    assert set(answer["parts"]["plane"]) >= {"completeness", "outlier_share", "rms_mm", "median_mm"}
    assert all(Path(file).is_file() for file in answer["files"])
    assert len(read_ply(scanned.out / "cloud.ply")["x"]) == answer["points"]
    assert (scanned.out / "maps/fringe_phase.projector_px.left.npy").is_file()


def test_calibrations_are_listed_and_what_is_not_there_is_named(unglare):
    assert unglare("calibrations", "list", "--json").answer == {"calibrations": []}
    done = unglare("calibrations", "withdraw", "3")
    assert (done.status, "no calibration 3" in done.err) == (1, True)
    done = unglare("calibrations", "keep", "no-scan", "zones")
    assert (done.status, "no scan 'no-scan'" in done.err) == (1, True)
    done = unglare("scan", *SMALL, "--given", "Ramp=3")
    assert (done.status, "hdr-fringe takes no Ramp from outside" in done.err) == (1, True)


def test_an_exported_scan_is_imported_with_the_same_cloud_and_replayed(unglare, scanned):
    first = scanned.done.answer
    done = unglare("import", scanned.out / "capture.json", "--json")
    assert done.status == 0, done.err
    hashes = [[s["result_hash"] for s in a["stages"]] for a in (first, done.answer)]
    assert hashes[0] == hashes[1]
    assert done.answer["points"] == first["points"]
    for target in (scanned.out, first["scan"]):
        replayed = unglare("replay", target, "--data", scanned.data, "--json")
        assert replayed.status == 0, replayed.err
        assert replayed.answer["same"]


def test_settings_reach_the_stages(unglare):
    settings = (
        "--set",
        "exposures.exposures_ms=50,100",
        "--set",
        "fringe_phase.unwrapping=cascade",
    )
    done = unglare("scan", *SMALL, *settings, "--json")
    assert done.status == 0, done.err
    assert done.answer["light_s"] > 12 * 0.15


def test_a_scan_is_summed_up_for_people(unglare):
    done = unglare("scan", *SMALL, "--quiet")
    assert done.status == 0
    assert "stereo_cloud" in done.out
    assert "complete" in done.out
    assert "Traceback" not in done.out + done.err


def test_an_old_scan_is_exported(unglare, scanned, tmp_path):
    scan = scanned.done.answer["scan"]
    done = unglare("export", scan, "--data", scanned.data, "--out", tmp_path / "out", "--json")
    assert done.status == 0, done.err
    assert str(tmp_path / "out/cloud.ply") in done.answer["files"]


WRONG = {
    "setting that isn't allowed": (["--set", "exposures.budget=quick"], "fast, balanced, thorough"),
    "setting that isn't there": (["--set", "exposures.colour=3"], "no setting 'colour'"),
    "stage that isn't there": (["--set", "polish.time=3"], "no stage 'polish'"),
    "setting of another form": (["--set", "budget"], "STAGE.FIELD=VALUE"),
    "method that isn't there": (["--method", "magic"], "no method 'magic'"),
    "preset that isn't there": (["--preset", "magic"], "no preset 'magic'"),
    "rig that isn't there": (["--rig", "magic"], "no rig 'magic'"),
    "module that isn't there": (["--rig", "magic.rigs:make"], "can't be loaded"),
    "scene that isn't there": (["--scene", "magic"], "no scene 'magic'"),
    "size that can't be": (["--size", "1x1"], "1x1"),
    "option that isn't there": (["--rig-option", "magic=1"], "no option 'magic'"),
    "scan that isn't there": (["--resume", "magic"], "no scan 'magic'"),
}


@pytest.mark.parametrize(("arguments", "words"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_one_sentence_and_a_status(unglare, arguments, words):
    done = unglare("scan", *arguments, "--json", "--quiet")
    assert done.status == 1
    assert words in done.answer["error"]
    last = done.err.strip().splitlines()[-1]
    assert last.startswith("unglare: ")
    assert words in last
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    "arguments",
    [
        ("scan", "--bogus"),
        ("scan", "--seed", "x"),
        ("export",),
        ("nothing",),
        ("bench", "--rounds", "0"),
    ],
)
def test_a_wrong_option_has_another_status(unglare, arguments):
    assert unglare(*arguments).status == 2


def test_a_place_that_holds_other_things_is_refused_before_anything_is_captured(unglare, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/notes.txt").write_text("mine")
    done = unglare("scan", *SMALL, "--out", tmp_path / "out", "--json")
    assert done.status == 1
    assert "isn't empty" in done.answer["error"]
    assert "scan" not in done.answer


def test_a_rig_that_fails_loses_nothing(unglare, impatient):
    fault = ("--rig-option", "fail_after_frames=8", "--rig-option", "fail_for_good=true")
    done = unglare("scan", *SMALL, *fault, "--json", "--quiet")
    assert done.status == 1
    assert done.answer["status"] == "failed"
    assert "captured frame" in done.answer["error"]
    assert done.answer["scan"]
    assert done.answer["stages"][0]["status"] == "failed" or done.answer["stages"][0]["duration_s"]


def test_a_failed_check_stops_an_unattended_scan(unglare):
    dark = ("--rig-option", "white_e_per_ms=0.001", "--rig-option", "ambient_e_per_ms=0")
    done = unglare("scan", *SMALL, *dark, "--json", "--quiet")
    assert done.status == 1
    assert done.answer["status"] == "failed"
    assert done.answer["error"].count("\n") == 0


def test_ctrl_c_cancels_and_keeps_the_scan(unglare, monkeypatch, tmp_path):
    wait, presses = JobThreads.wait, iter([True])

    def press_once(self: JobThreads, job: str, timeout_s: float | None = None) -> bool:
        if next(presses, False):
            raise KeyboardInterrupt
        return wait(self, job, timeout_s)

    monkeypatch.setattr(JobThreads, "wait", press_once)
    done = unglare("scan", *SMALL, "--json", "--quiet")
    assert done.status == 130
    assert done.answer["status"] == "cancelled"
    assert "kept" in done.answer["error"]
    # What it goes on with may be set: an operator who was tired of waiting wants less.
    scan = done.answer["scan"]
    again = unglare("scan", "--resume", scan, "--set", "exposures.steps=5", "--json", "--quiet")
    assert again.status == 0, again.err
    assert again.answer["status"] == "finished"
    with real_house(tmp_path / "data") as services:
        stages = {stage.name: stage for stage in services.scan(scan).stages}
    assert stages["exposures"].settings["steps"].value == 5


def test_a_scan_whose_process_was_killed_goes_on(unglare, tmp_path):
    with real_house(tmp_path / "data") as services:
        options = {"scene": "plane", "size": "160x120"}
        request = CreateScan(method="hdr-fringe", rig_options=options)
        scan = services.create_scan(request, "ada").id
        job = JobRow("job", scan, JobStatus.RUNNING, "ada", utc_now(), unattended=True)
        with services.context.database.transaction() as repositories:
            repositories.jobs.add(job)
    done = unglare("scan", "--resume", scan, "--json", "--quiet")
    assert done.status == 0, done.err
    assert done.answer["status"] == "finished"


def test_methods_are_described_as_json(unglare):
    answer = unglare("methods", "--json").answer
    assert {"hdr-fringe", "adaptive-code"} <= {m["name"] for m in answer["methods"]}


def test_a_methods_settings_are_listed_with_what_is_allowed(unglare):
    out = unglare("methods", "hdr-fringe").out
    assert "exposures.budget" in out
    assert "fast, balanced, thorough" in out.replace("\n", " ")


def test_a_healthy_rig_has_no_problems(unglare):
    done = unglare("rigs", "check", *SMALL, "--json")
    assert done.status == 0, done.err
    assert done.answer["ok"]
    assert {f["camera"] for f in done.answer["frames"]} == {"left", "right"}
    assert [f["width_px"] for f in done.answer["frames"]] == [160, 160]


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("white_e_per_ms=0.001", "doesn't see the projector"),
        ("white_e_per_ms=100000", "saturated"),
        ("fail_after_frames=0", "left"),
        ("projector_fail_after_shows=0", "projector"),
    ],
)
def test_a_rigs_problem_is_named(unglare, impatient, option, words):
    done = unglare(
        "rigs",
        "check",
        *SMALL,
        "--rig-option",
        option,
        "--rig-option",
        "fail_for_good=true",
        "--json",
    )
    assert done.status == 1
    assert words in done.answer["error"]


def test_noise_is_as_predicted(unglare):
    done = unglare("noise", "--size", "320x240", "--json")
    assert done.status == 0, done.err
    assert done.answer["within_10_percent"]
    assert done.answer["wild"] == 0


def test_noise_needs_a_rig_that_is_what_it_says(unglare, monkeypatch):
    """Facts that promise less noise than there is have to show."""
    facts = SimulatedRig.facts

    def boast(self):
        told = facts(self)
        cameras = {
            n: type(c)(**{**vars(c), "full_well_e": 4 * c.full_well_e})
            for n, c in told.cameras.items()
        }
        return type(told)(cameras, told.reference, told.projector)

    monkeypatch.setattr(SimulatedRig, "facts", boast)
    done = unglare("noise", "--size", "160x120", "--json")
    assert done.status == 1
    assert "10 % off" in done.answer["error"]


def test_strategies_are_compared_with_table_and_pictures(unglare, tmp_path):
    folder = tmp_path / "compared"
    done = unglare(
        "compare", "--scene", "high-contrast", "--size", "320x240", "--out", folder, "--json"
    )
    assert done.status == 0, done.err
    rows = {row["strategy"]: row for row in done.answer["strategies"]}
    assert set(rows) == {
        "planned", "paper", "planned_same_time", "paper_weighted", "single_low", "single_high",
    }  # fmt: skip
    assert rows["planned"]["completeness"] > max(
        rows["single_low"]["completeness"], rows["single_high"]["completeness"]
    )
    assert rows["planned_same_time"]["light_s"] <= rows["paper"]["light_s"] * 1.001
    assert rows["planned_same_time"]["completeness"] >= rows["paper"]["completeness"]
    lines = (folder / "comparison.csv").read_text().splitlines()
    assert lines[0].startswith("strategy,part,completeness")
    assert {"planned.png", "single_low.png", "overview.png"} <= {p.name for p in folder.iterdir()}
    again = unglare("compare", "--out", tmp_path / "data", "--json")
    assert "isn't empty" in again.answer["error"]


def test_the_built_in_benchmark_reports(unglare):
    done = unglare("bench", "--size", "320x240", "--rounds", "1", "--json")
    assert done.status == 0, done.err
    assert done.answer["points"] > 10_000
    assert all(t["best_ms"] > 0 and np.isfinite(t["over_copy"]) for t in done.answer["timings"])


def test_serve_passes_its_options_on(unglare, monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(main, "serve", lambda settings, **options: seen.append((settings, options)))
    unglare("serve", "--port", "0", "--host", "127.0.0.2", "--data", tmp_path / "d", "--rig", "a:b")
    unglare("demo", "--port", "0", "--scene", "metal")
    (served, _), (demo, options) = seen
    assert (served.port, served.host, served.rig) == (0, "127.0.0.2", "a:b")
    assert served.data_folder == tmp_path / "d"
    assert demo.rig_options["scene"] == "metal"
    assert options["prepare"]


def test_a_bad_setting_of_the_server_is_one_sentence(unglare, monkeypatch):
    monkeypatch.setenv("UNGLARE_TOKEN", "short")
    done = unglare("serve")
    assert done.status == 1
    assert "UNGLARE_TOKEN" in done.err


def test_the_demo_begins_one_scan_and_no_second(tmp_path):
    with real_house(tmp_path) as services:
        options = {"scene": "plane", "size": "160x120"}
        begin_first_scan(services, options)
        begin_first_scan(services, options)
        (only,) = services.scans()
    assert only.name == "First scan"
    assert only.stages_done >= 1


def test_a_demo_whose_rig_cannot_be_opened_serves_all_the_same(tmp_path, caplog):
    with real_house(tmp_path) as services:
        begin_first_scan(services, {"scene": "magic"})
    assert "no scene 'magic'" in caplog.text
