"""A report as a value: tables, figures, sentences. Written as JSON, CSV, pictures, and a page that anybody can open."""

import csv
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from backend.services.contact_sheet import Picture, png
from backend.services.export_folder import FolderKind, refuse_foreign, whole_folder

REPORT = FolderKind("report.json", "unglare-report")
PAGE = "report.html"


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    name: str
    """Its name in JSON and CSV."""
    title: str
    """Its name for people."""
    form: str = ""
    """How a number is written for people, as Python's format has it."""

    def words(self, value: object) -> str:
        """Write a value for people; nothing for what isn't known.

        Examples
        --------
        >>> Column("share", "share", ".1%").words(0.123), Column("share", "share", ".1%").words(None)
        ('12.3%', '')
        """
        if value is None:
            return ""
        return f"{value:{self.form}}" if isinstance(value, int | float) else str(value)


@dataclass(frozen=True)
class ReportTable:
    """One table: JSON values by column."""

    name: str
    """Of its file."""
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Any], ...]

    def csv(self) -> str:
        """Write the table with full figures; what isn't known is empty."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.name for column in self.columns])
        for row in self.rows:
            writer.writerow([row.get(column.name) for column in self.columns])
        return text.getvalue()

    def document(self) -> dict[str, Any]:
        """Write the table as JSON values."""
        return {"title": self.title, "rows": [dict(row) for row in self.rows]}


@dataclass(frozen=True)
class Figure:
    """One picture with what it shows."""

    name: str
    """Of its file."""
    caption: str
    picture: Picture


@dataclass(frozen=True)
class Report:
    """What one comparison found."""

    name: str
    """As the command that makes it."""
    title: str
    introduction: tuple[str, ...]
    """Paragraphs: what was measured, and how it is counted."""
    tables: tuple[ReportTable, ...]
    figures: tuple[Figure, ...] = ()
    findings: tuple[str, ...] = ()
    """What the tables say, one sentence each."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON values."""

    def document(self) -> dict[str, Any]:
        """Write everything but the pictures as JSON values."""
        return {
            "report": self.name,
            "title": self.title,
            "introduction": list(self.introduction),
            "tables": {table.name: table.document() for table in self.tables},
            "findings": list(self.findings),
            **self.facts,
        }

    def page(self) -> str:
        """Write a page that needs nothing but the pictures beside it."""
        template = files("frontend_assets") / "report.html"
        parts = [
            *(_paragraph(text) for text in self.introduction),
            _list(self.findings),
            *(_table(table) for table in self.tables),
            *(_figure(figure) for figure in self.figures),
        ]
        return Template(template.read_text(encoding="utf-8")).substitute(
            title=html.escape(self.title), body="\n".join(part for part in parts if part)
        )


def write_report(folder: Path, report: Report) -> tuple[Path, ...]:
    """Write `report.html`, a CSV file per table, a PNG file per figure and `report.json`; return the files.

    Raises
    ------
    ConflictError
        If the folder holds anything else than an older report, or can't be written.
    StorageFullError
        If there is no room; nothing is left behind.
    """
    with whole_folder(folder, REPORT) as target:
        for table in report.tables:
            target.write(f"{table.name}.csv", (table.csv().encode(),))
        for figure in report.figures:
            target.write(f"{figure.name}.png", (png(figure.picture),))
        target.write(PAGE, (report.page().encode(),))
        document = {"format": REPORT.format, "version": 1, **report.document()}
        target.write_json(REPORT.index_file, document | {"files": dict(target.hashes)})
        names = sorted(target.hashes)
    return tuple(folder / name for name in [*names, REPORT.index_file])


def refuse_report_folder(folder: Path) -> None:
    """Raise `ConflictError` if a report can't be written there: before long work is done for it."""
    refuse_foreign(folder.expanduser().absolute(), REPORT)


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _list(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>"


def _table(table: ReportTable) -> str:
    head = "".join(f"<th>{html.escape(column.title)}</th>" for column in table.columns)
    body = "".join(f"<tr>{_cells(table, row)}</tr>" for row in table.rows)
    title = html.escape(table.title)
    return f"<h2>{title}</h2>\n<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cells(table: ReportTable, row: Mapping[str, Any]) -> str:
    cells = []
    for column in table.columns:
        value = row.get(column.name)
        kind = ' class="number"' if isinstance(value, int | float) else ""
        cells.append(f"<td{kind}>{html.escape(column.words(value))}</td>")
    return "".join(cells)


def _figure(figure: Figure) -> str:
    caption, source = html.escape(figure.caption), html.escape(f"{figure.name}.png")
    return (
        f'<figure><img src="{source}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'
    )
