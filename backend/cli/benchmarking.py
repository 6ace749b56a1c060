"""`unglare bench`: whether this machine is fast enough for its cameras."""

from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.options import AsJson, Quiet
from backend.cli.output import ProgressLines, answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.services.benchmarks import BenchmarkReport


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(bench)


def bench(
    size: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the cameras.")
    ] = "2560x1920",
    rounds: Annotated[int, typer.Option(min=1, max=100, help="The best of so many counts.")] = 5,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Time decoding, matching and the whole chain to the cloud, beside copying the frames; and its memory."""
    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        progress.step("load", 0.0)
        from backend.services.benchmarks import run_benchmark  # compiles kernels the first time

        found = run_benchmark(
            size, rounds=rounds, progress=lambda done, text="": progress.step(text, 0.0)
        )
        progress.finish()
        answer.update(found.document())
    if not as_json:
        _show(found)


def _show(found: "BenchmarkReport") -> None:
    rows = table(f"{found.size}, two cameras", ">best of " + str(found.rounds), ">over copying")
    rows.add_row("copy 12 frames", f"{found.copy_ms:.2f} ms", "1.0")
    for timing in found.timings:
        rows.add_row(timing.name, f"{timing.best_ms:.1f} ms", f"{timing.over_copy:.1f}")
    rows.add_row(
        "frames to cloud",
        f"{1e3 * found.chain_s:.0f} ms",
        f"{1e3 * found.chain_s / found.copy_ms:.1f}",
    )
    console().print(rows)
    memory = ""
    if found.peak_mb is not None:
        share = found.peak_mb / found.frames_mb
        memory = f", {found.peak_mb:.0f} MB beside them at the most ({share:.1f} times the frames)"
    console().print(f"{found.points} points of {found.frames_mb:.0f} MB of frames{memory}")
