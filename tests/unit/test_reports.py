"""Reports as values: what is written into a folder, what people and programs read."""

import csv
import json

import numpy as np
import pytest

from backend.domain.errors import ConflictError
from backend.services.contact_sheet import Panel, Row, contact_sheet, drawn
from backend.services.line_chart import Line, line_chart, ticks
from backend.services.report_document import Column, Figure, Report, ReportTable, write_report

COLUMNS = (Column("part", "part"), Column("share", "share", ".1%"))
ROWS = ({"part": "<black>", "share": 0.123}, {"part": "shiny", "share": None})
PICTURE = np.full((20, 30, 3), 90, np.uint8)


def a_report() -> Report:
    return Report(
        name="example",
        title="An example & more",
        introduction=("What was measured.",),
        tables=(ReportTable("parts", "Parts", COLUMNS, ROWS),),
        figures=(Figure("overview", "all of it", PICTURE),),
        findings=("Shiny parts shine.",),
        facts={"seed": 3},
    )


def test_a_report_is_written_whole_and_can_be_replaced(tmp_path):
    for _ in range(2):
        files = write_report(tmp_path / "out", a_report())
    assert {f.name for f in files} == {"report.html", "parts.csv", "overview.png", "report.json"}
    assert all(f.is_file() for f in files)
    with (tmp_path / "out/parts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"part": "<black>", "share": "0.123"}, {"part": "shiny", "share": ""}]
    document = json.loads((tmp_path / "out/report.json").read_text())
    assert document["tables"]["parts"]["rows"][0]["share"] == 0.123
    assert document["seed"] == 3


def test_a_page_says_everything_and_brings_no_markup_along():
    page = a_report().page()
    for words in ("An example &amp; more", "&lt;black&gt;", "12.3%", "Shiny parts", "overview.png"):
        assert words in page
    assert "<black>" not in page


def test_a_folder_with_other_things_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConflictError, match="isn't empty"):
        write_report(tmp_path, a_report())


def test_a_sheet_takes_rows_of_different_widths():
    wide, high = drawn(np.zeros((90, 360))), drawn(np.zeros((360, 90)))
    sheet = contact_sheet(
        [
            Row("two", (Panel("wide", wide), Panel("high", high))),
            Row("one", (Panel("wide", wide),)),
            Row("none", ()),
        ]
    )
    assert sheet.shape == (360 + 44 + 90 + 44, 360 + 90, 3)
    assert contact_sheet([], otherwise="nothing").shape[1] == 360


@pytest.mark.parametrize("span", [(0, 1), (0, 7.3), (-60, 60), (0.2, 0.21), (0, 0)])
def test_ticks_are_few_and_round(span):
    found = ticks(*span)
    assert len(found) <= 9
    assert all(span[0] - 1e-9 <= tick <= span[1] + 1e-9 for tick in found)


def test_a_chart_draws_its_lines_and_passes_over_what_is_not_known():
    x = np.arange(5.0)
    empty = line_chart("none", [Line("a", x, x * np.nan)], x_title="x", y_title="y")
    line = line_chart("one", [Line("a", x, np.where(x == 2, np.nan, x))], x_title="x", y_title="y")
    assert empty.shape == line.shape
    assert (line[60:340] != 255).sum() > (empty[60:340] != 255).sum()
