"""`unglare validate reflection`: the issue's figures, with seeds that nothing was tuned to."""

import csv
import json
from pathlib import Path

import pytest

from backend.cli.application import run

pytestmark = pytest.mark.scan


def test_the_table_is_written_and_the_figures_are_reached(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "report"
    arguments = ("--chain", "d", "--chain", "B", "--seeds", "1", "--first-seed", "77")

    status = run(
        ["validate", "reflection", *arguments, "--phases", "4000", "--out", str(folder), "--json"]
    )

    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert status == 0
    assert [text for text in answer["findings"] if not text.startswith("reached")] == []
    film = answer["tables"]["errors"]["rows"][0]
    assert film["raw_full"] == pytest.approx(78, rel=0.03)
    assert film["log"] < 9
    assert film["inverse"] < 8.5
    lines = answer["tables"]["lines"]["rows"][0]
    assert lines["raw_full"] == pytest.approx(10.0, rel=0.1)
    assert lines["log"] < 0.75 * lines["raw_full"]  # the paper's "almost one third"
    assert any("claim is reproduced" in text for text in answer["introduction"])
    with (folder / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["chain"][0] for row in rows] == ["D", "B"]
    assert {f.name for f in folder.iterdir()} >= {
        "report.html", "report.json", "lines.csv", "systematic.csv", "choice.csv", "everywhere.png",
        "at_lines.png", "over_phase.png",
    }  # fmt: skip


def test_unknown_chains_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    status = run(["validate", "reflection", "--chain", "Q", "--quiet"])

    assert status == 1
    assert "There is no chain 'Q'" in capsys.readouterr().err
