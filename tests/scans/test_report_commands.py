"""`unglare report`: one command each, with table, CSV, picture and page."""

import json
from pathlib import Path
from typing import Any

import pytest

from backend.cli.application import run

pytestmark = pytest.mark.scan


@pytest.fixture
def unglare(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("UNGLARE_DATA_FOLDER", str(tmp_path / "data"))

    def command(*arguments: str) -> dict[str, Any]:
        status = run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        answer = json.loads(out.splitlines()[-1]) if "--json" in arguments else {}
        return {"status": status, "out": out, "err": err, "answer": answer}

    return command


def test_table_i_follows_from_the_calibration(unglare, tmp_path):
    sizes = ("--size", "160x120", "--projector-size", "1024x768")
    done = unglare("report", "table-i", *sizes, "--out", tmp_path / "out", "--json")
    assert done["status"] == 0, done["err"]
    rows = done["answer"]["tables"]["table_i"]["rows"]
    twenty = next(r for r in rows if r["camera"] == "left" and r["height_mm"] == 20)
    # Base about 98 mm across the projector's view, 700 mm away, focal length 1792 px
    assert twenty["median_px"] == pytest.approx(1792 * 98.5 * 20 / (700 * 680), rel=0.05)
    assert {Path(f).name for f in done["answer"]["files"]} == {
        "table_i.csv",
        "table_i.png",
        "report.html",
        "report.json",
    }
    assert "dilation of 5 px covers" in done["answer"]["findings"][0]
    assert "deviation" in unglare("report", "table-i", *sizes, "--quiet")["out"]


def test_a_rig_without_calibration_has_no_table_i(unglare):
    done = unglare("report", "table-i", "--rig-option", "calibrated=false", "--json", "--quiet")
    assert done["status"] == 1
    assert "calibrate it" in done["answer"]["error"]


def test_table_iv_compares_mask_no_mask_and_spray(unglare, tmp_path):
    sizes = ("--size", "320x240", "--projector-size", "256x192")
    done = unglare("report", "table-iv", *sizes, "--out", tmp_path / "out", "--json", "--quiet")
    assert done["status"] == 0, done["err"]
    tables = done["answer"]["tables"]
    rows = {row["part"]: row for row in tables["table_iv"]["rows"]}
    assert set(rows) == {"all", "table", "black", "dark", "shiny"}
    assert all(row["sprayed"] > 0 for row in rows.values())
    assert rows["all"]["mask_share"] > rows["all"]["no_mask_high_share"]
    measurements = tables["measurements"]["rows"]
    assert {row["variant"] for row in measurements} == {
        "sprayed",
        "no_mask_middle",
        "no_mask_high",
        "mask",
    }
    assert all(row["error"] is None for row in measurements)
    decoded = {(row["variant"], row["part"]): row for row in tables["decoding"]["rows"]}
    assert decoded["no_mask_middle", "black"]["fixed_completeness"] < 0.5
    assert (tmp_path / "out/table_iv.csv").read_text().startswith("part,sprayed,no_mask_middle")
    assert (tmp_path / "out/table_iv.png").is_file()
