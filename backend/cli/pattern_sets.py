"""`unglare patterns`: what a method projects, and test patterns, as pictures."""

import tempfile
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.options import AsJson, Quiet, Settings, parse_settings
from backend.cli.output import ProgressLines, answering, console, quiet_logging, table
from backend.domain.errors import InvalidSettingError

if TYPE_CHECKING:
    from backend.devices.pattern_set import PatternSet

_MOST_LISTED = 12

Size = Annotated[
    str, typer.Option("--projector-size", metavar="WIDTHxHEIGHT", help="Size of the projector.")
]


class Packing(StrEnum):
    """Whether images for a projector's memory are written besides."""

    NONE = "none"
    BITS_24 = "24bit"


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    group = typer.Typer(
        name="patterns",
        help="Patterns as pictures: what a method projects, for projectors that play from memory; test patterns.",
        no_args_is_help=True,
    )
    group.command("export")(export)
    group.command("test")(draw)
    application.add_typer(group)


def export(
    projector_size: Size,
    out: Annotated[Path, typer.Option(help="Folder for the pictures and patterns.json.")],
    method: Annotated[
        str, typer.Option(help="Measuring method, see unglare methods.")
    ] = "hdr-fringe",
    preset: Annotated[str | None, typer.Option(help="Named set of settings of the method.")] = None,
    settings: Settings = None,
    gamma: Annotated[
        float, typer.Option(min=0.2, max=5.0, help="The projector's gamma; 1 where it is linear.")
    ] = 1.0,
    level: Annotated[
        list[int] | None,
        typer.Option(
            min=0, max=255, help="Another even field, beside white and black. Repeatable."
        ),
    ] = None,
    test_patterns: Annotated[
        bool, typer.Option("--test-patterns", help="Write the test patterns, too.")
    ] = False,
    pack: Annotated[
        Packing,
        typer.Option(help="24bit: also the images for the flash of a LightCrafter 4500."),
    ] = Packing.NONE,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write every pattern that a scan with a method would project as PNG, in the order of the scan.

    Two short scans with the simulated rig find out which ones: that takes half a minute or two.
    """
    from backend.cli.house import open_services
    from backend.services.pattern_sets import (
        Wanted,
        export_patterns,
        pictures_of,
        record_trials,
        refuse_folder,
    )

    quiet_logging()
    with answering(as_json) as answer:
        width_px, height_px = _size(projector_size)
        wanted = Wanted(
            method=method,
            width_px=width_px,
            height_px=height_px,
            preset=preset,
            settings=parse_settings(settings),
            gamma=gamma,
            levels=tuple(level or ()),
            test_patterns=test_patterns,
        )
        refuse_folder(out)
        with (
            tempfile.TemporaryDirectory(prefix="unglare-patterns-") as place,
            ProgressLines(hidden=quiet) as progress,
            open_services(Path(place), progress) as services,
        ):
            trials = record_trials(services, wanted)
            progress.finish()
        written = export_patterns(*pictures_of(trials, wanted), wanted, out, pack.value)
        answer.update({"folder": str(out), **written.model_dump(mode="json")})
        if not as_json:
            _show(written, out)


def _show(written: "PatternSet", folder: Path) -> None:
    rows = table(">number", "file", "what", "shown by")
    for pattern in written.patterns[:_MOST_LISTED]:
        rows.add_row(
            str(pattern.number), pattern.file, pattern.what, ", ".join(pattern.stages) or "-"
        )
    console().print(rows)
    if len(written.patterns) > _MOST_LISTED:
        console().print(f"... and {len(written.patterns) - _MOST_LISTED} more, see patterns.json")
    console().print(
        f"{len(written.patterns)} patterns of {written.width_px}x{written.height_px} px in {folder}"
    )
    if written.images:
        console().print(
            f"{len(written.images)} images for flash, {written.bit_depth} bit per pattern: flash_00.bmp and so on,"
            " to be stored in this order"
        )
    for sentence in written.left_out:
        console().print(sentence)


def draw(
    kind: Annotated[
        str,
        typer.Option(
            help="One of white, black, checker, squares, focus, lines, identify.",
            show_default=False,
        ),
    ],
    projector_size: Size,
    out: Annotated[Path, typer.Option(help="File to write, .png or .bmp.")],
    label: Annotated[str, typer.Option(help="Name that identify writes.")] = "projector",
    cell: Annotated[
        int | None,
        typer.Option(min=1, help="Width of a checker's squares in pixels.", show_default=False),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a test pattern as a picture."""
    from backend.numerics.test_patterns import TEST_PATTERNS
    from backend.services.pattern_sets import export_test_pattern

    quiet_logging()
    with answering(as_json) as answer:
        width_px, height_px = _size(projector_size)
        export_test_pattern(kind, width_px, height_px, out, label=label, cell_px=cell)
        answer.update({"kind": kind, "file": str(out), "size": [width_px, height_px]})
        if not as_json:
            console().print(
                f"{kind}, {width_px}x{height_px} px, written to {out}: {TEST_PATTERNS[kind]}"
            )


def _size(text: str) -> tuple[int, int]:
    width, times, height = text.lower().partition("x")
    if not (times and width.strip().isdecimal() and height.strip().isdecimal()):
        raise InvalidSettingError(
            f"--projector-size {text} can't be read: write WIDTHxHEIGHT, e.g. 912x1140."
        )
    return int(width), int(height)
