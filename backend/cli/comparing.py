"""`unglare compare` and `noise`: figures against the truth of the simulated rig."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.cli.house import open_services, who
from backend.cli.options import (
    AsJson,
    DataFolder,
    Quiet,
    RigName,
    RigOptions,
    Scene,
    Seed,
    Settings,
    Size,
    parse_rig_options,
    parse_settings,
)
from backend.cli.output import ProgressLines, answering, console, quiet_logging, table
from backend.cli.scanning import truth_words

if TYPE_CHECKING:
    from backend.services.comparing import Compared


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(compare)
    application.command()(noise)


def compare(
    scene: Scene = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for comparison.csv and the pictures.")
    ] = None,
    size: Size = None,
    seed: Seed = None,
    rig: RigName = "simulated",
    rig_options: RigOptions = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure a scene by every exposure strategy, the paper's among them, and compare with the truth.

    Writes a table and, per strategy, white field, fringes, wrapped and absolute phase and depth side by side.
    """
    from backend.services import comparing

    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        options = parse_rig_options(rig_options, scene=scene, size=size, seed=seed)
        if out is not None:
            comparing.refuse_folder(out)
        with open_services(data) as services:
            results = comparing.compare(
                services.context,
                options,
                rig=rig,
                progress=lambda done, text="": progress.step(text, 0.0),
            )
        progress.finish()
        answer["strategies"] = comparing.describe(results)
        answer["files"] = []
        if out is not None:
            answer["files"] = [str(file) for file in comparing.write_comparison(out, results)]
        if all(result.error for result in results):
            answer["error"] = results[0].error
    if not as_json:
        _show(results)
        if out is not None:
            console().print(f"table and pictures are in {out}")


def _show(results: "Sequence[Compared]") -> None:
    from backend.numerics.scoring import DEFINITION
    from backend.services.comparing import part_figures, table_row

    out = console()
    rows = table(
        "strategy", ">complete", ">outliers", ">rms mm", ">median mm", ">points", ">light s", ">in all s",
        "exposures ms",
    )  # fmt: skip
    for result in results:
        row = table_row(result)
        rows.add_row(
            row["strategy"],
            _words(row, "completeness", ".2%"),
            _words(row, "outlier_share", ".3%"),
            _words(row, "rms_mm", ".4f"),
            _words(row, "median_mm", ".4f"),
            _words(row, "points", "d"),
            _words(row, "light_s", ".2f"),
            _words(row, "total_s", ".2f"),
            result.error or ", ".join(f"{t:.1f}" for t in result.exposures_ms),
        )
    out.print(rows)
    for result in results:
        for part, figures in part_figures(result).items():
            out.print(f"  {result.strategy.name}, {part}: {truth_words(figures)}")
    out.print(DEFINITION)


def _words(row: Mapping[str, Any], name: str, form: str) -> str:
    value = row[name]
    return "" if value is None else f"{value:{form}}"


def noise(
    scene: Annotated[str, typer.Option(help="A smooth scene of the simulated rig.")] = "plane",
    settings: Settings = None,
    size: Size = None,
    seed: Seed = None,
    rig_options: RigOptions = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure the noise of the phase against its prediction and the Cramer-Rao bound; 10 % are allowed."""
    from backend.contract.requests import CreateScan, StartRun
    from backend.services.noise_check import measure_noise

    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        request = CreateScan(
            method="hdr-fringe",
            rig_options=parse_rig_options(rig_options, scene=scene, size=size, seed=seed),
            name=f"Noise on {scene}",
            settings=parse_settings(settings),
        )
        with open_services(data, progress) as services:
            progress.step("rig", 0.0, "opening")
            scan = services.create_scan(request, who()).id
            answer["scan"] = scan
            state = services.run(scan, StartRun(until="fringe_phase", unattended=True), who())
            if state.job and state.job.error:
                answer["error"] = state.job.error
                return
            found = measure_noise(services.context, scan)
        progress.finish()
        answer.update(found.document())
        if not as_json:
            rows = table("noise of the projector column", ">px")
            rows.add_row("measured", f"{found.measured_px:.5f}")
            rows.add_row("predicted", f"{found.predicted_px:.5f}")
            rows.add_row("Cramer-Rao bound", f"{found.bound_px:.5f}")
            console().print(rows)
            console().print(
                f"measured over predicted {found.over_predicted:.3f}, over the bound {found.over_bound:.3f}, "
                f"{found.pixels} pixels, {found.wild} of them wild, bias {found.bias_px:+.5f} px"
            )
        if not found.is_as_predicted:
            answer["error"] = (
                f"The noise is {found.over_predicted:.2f} times the predicted one and {found.over_bound:.2f} times "
                "the bound, more than 10 % off: look at the rig's facts (read noise, full well, black level)."
            )
