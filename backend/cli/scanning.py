"""`unglare scan`: a whole scan, unattended."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.cli.house import Monitor, open_services, who
from backend.cli.options import (
    AsJson,
    Chain,
    DataFolder,
    Given,
    ProjectorSize,
    Quiet,
    RigOptions,
    ScanRig,
    Scene,
    Seed,
    Settings,
    Size,
    parse_given,
    parse_rig_options,
    parse_settings,
    with_uploads,
)
from backend.cli.output import Document, ProgressLines, answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.contract.scans import ScanState, StageState
    from backend.services.services import Services

Out = Annotated[
    Path | None, typer.Option(help="Write scan.json, cloud.ply and maps into this folder.")
]
WithFrames = Annotated[
    bool, typer.Option("--frames", help="Also write the captured frames in the import format.")
]


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(scan)


def scan(
    rig: ScanRig = None,
    scene: Scene = None,
    chain: Chain = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="Measuring method, see unglare methods.  [default: the one that the rig is made for, or hdr-fringe]",
            show_default=False,
        ),
    ] = None,
    settings: Settings = None,
    given: Given = None,
    size: Size = None,
    projector_size: ProjectorSize = None,
    seed: Seed = None,
    rig_options: RigOptions = None,
    monitor: Monitor = None,
    preset: Annotated[str | None, typer.Option(help="Named set of settings of the method.")] = None,
    name: Annotated[str, typer.Option(help="Name of the scan.")] = "",
    out: Out = None,
    frames: WithFrames = False,
    resume: Annotated[
        str | None, typer.Option(metavar="SCAN", help="Go on with a scan that was interrupted.")
    ] = None,
    data: DataFolder = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Make a scan unattended: review gates pass on ok or warning, and stop on failure."""
    from backend.contract.requests import CreateScan
    from backend.devices.loading import method_for, rig_for

    quiet_logging()
    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        options = parse_rig_options(
            rig_options,
            scene=scene,
            size=size,
            projector_size=projector_size,
            seed=seed,
            chain=chain,
        )
        if resume:
            rig = _revived(resume, data)
        rig = rig or rig_for(options.get("scene"), method or "")
        method = method or method_for(rig)
        request = CreateScan(
            method=method,
            rig=rig,
            rig_options=options,
            name=name,
            preset=preset,
            settings=parse_settings(settings),
            given=parse_given(given),
        )
        with open_services(data, progress, rig=rig, monitor=monitor) as services:
            refuse_place(services, out)
            progress.step("rig", 0.0, "opening")
            if resume:
                method = services.scan(resume).method
            uploaded = with_uploads(services, method, request.settings)
            if resume:
                edit_settings(services, resume, uploaded)
            request = request.model_copy(update={"settings": uploaded})
            chosen = resume or services.create_scan(request, who()).id
            run_and_export(services, chosen, answer, progress, out=out, frames=frames)
    if not as_json:
        show_summary(answer)


def edit_settings(services: "Services", scan: str, changes: dict[str, dict[str, Any]]) -> None:
    """Edit the settings of a scan that is there already: an imported or a resumed one."""
    from backend.contract.requests import EditSettings

    for stage, values in changes.items():
        revision = services.scan(scan).revision
        request = EditSettings(changes=values, reason="command line", revision=revision)
        services.edit(scan, stage, request, who())


def _revived(scan_id: str, data: Path | None) -> str:
    """Prepare a scan that shall go on, and return its rig: a projector page has to be open before the scan is run."""
    with open_services(data) as services:
        end_dead_job(services, scan_id, data)
        return services.scan(scan_id).rig


def end_dead_job(services: "Services", scan_id: str, data: Path | None) -> None:
    """Mark a scan's job as interrupted if the command that ran it was killed: no server is there to do so."""
    from backend.main import is_served
    from backend.settings import load_settings

    job = services.scan(scan_id).job
    if job and not job.status.ended and not is_served(load_settings(data_folder=data).data_folder):
        services.cancel(scan_id, who())


def refuse_place(services: "Services", out: Path | None) -> None:
    """Refuse a folder that an export couldn't go to now, not after minutes of capturing."""
    if out is not None:
        services.refuse_export(str(out))


def run_and_export(
    services: "Services",
    scan_id: str,
    answer: Document,
    progress: ProgressLines,
    *,
    out: Path | None,
    frames: bool,
) -> None:
    """Run a scan to its end, export it, and write what came of it into the answer."""
    from backend.contract.requests import StartRun

    answer.update({"scan": scan_id, "status": "running"})
    try:
        services.run(scan_id, StartRun(unattended=True), who())
    finally:
        answer.update(describe_scan(services.scan(scan_id)))
    if answer.get("error"):
        return
    if out is not None:
        files = services.export(scan_id, str(out), frames, who(), progress.part("export"))
        answer["files"] = [str(file) for file in files]
    answer.update(services.report(scan_id).document())
    progress.finish()


def describe_scan(state: "ScanState") -> Document:
    """Write a scan's state as the answer has it."""
    job = state.job
    status = job.status.value if job else state.status
    answer: Document = {
        "scan": state.id,
        "name": state.name,
        "method": state.method,
        "rig": state.rig,
        "status": status,
        "stages": [_describe_stage(stage) for stage in state.stages],
        "duration_s": round(sum(s.duration_s or 0.0 for s in state.stages), 3),
        "points": None,
        "files": [],
    }
    if job and job.error:
        answer["error"] = job.error
    return answer


def _describe_stage(stage: "StageState") -> Document:
    return {
        "name": stage.name,
        "status": stage.status.value,
        "message": stage.message,
        "duration_s": None if stage.duration_s is None else round(stage.duration_s, 3),
        "checks": [check.model_dump(mode="json") for check in stage.checks],
        "result_hash": stage.result_hash,
    }


def show_summary(answer: Document) -> None:
    """Print what a person wants to know of a finished scan."""
    out = console()
    rows = table("stage", "status", ">time", "finding")
    for stage in answer["stages"]:
        took = "" if stage["duration_s"] is None else f"{stage['duration_s']:.2f} s"
        rows.add_row(stage["name"], stage["status"].replace("_", " "), took, stage["message"])
    out.print(rows)
    out.print(f"scan {answer['scan']}: {answer['status']}, {_points(answer['points'])}")
    for name, figures in {"all": answer.get("truth"), **answer.get("parts", {})}.items():
        if figures:
            out.print(f"  {name}: {truth_words(figures)}")
    if answer.get("computing_s") is not None:
        out.print(f"own computing {answer['computing_s']:.1f} s, rig {answer['rig_s']:.1f} s")
    if answer["files"]:
        out.print(f"written to {Path(answer['files'][0]).parent}")


def truth_words(figures: dict[str, Any]) -> str:
    """Say how near to the truth a cloud is."""

    def number(name: str, form: str, unit: str) -> str:
        value = figures[name]
        return "none" if value is None else f"{value:{form}}{unit}"

    return (
        f"{number('completeness', '.3%', '')} complete, {number('outlier_share', '.3%', '')} outliers, "
        f"{number('over_exposed_share', '.3%', '')} over-exposed, rms {number('rms_mm', '.4f', ' mm')}, "
        f"median {number('median_mm', '.4f', ' mm')}, mean {number('mean_mm', '.4f', ' mm')} "
        f"± {number('std_mm', '.4f', ' mm')}"
    )


def _points(count: int | None) -> str:
    return "no cloud" if count is None else f"{count:,} points".replace(",", " ")
