"""`unglare rigs template`, `show` and `calibration`: what stands in a rig file, and what stands beside it."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.cli.options import AsJson, DataFolder
from backend.cli.output import answering, console, quiet_logging, table
from backend.domain.errors import InvalidSettingError, NotFoundError

if TYPE_CHECKING:
    from backend.devices.calibration_entries import CalibrationEntry
    from backend.devices.rig_file import RigFile
    from backend.devices.rig_shelf import RigShelf


def open_shelf(data: Path | None) -> "RigShelf":
    """Return the station's rig files."""
    from backend.devices.pages import PageDesk
    from backend.devices.rig_shelf import RigShelf
    from backend.settings import load_settings

    return RigShelf(load_settings(data_folder=data).rig_folder, PageDesk())


def template(
    kind: Annotated[
        str,
        typer.Argument(metavar="KIND", help="stereo-page, mirror-page, lightcrafter or webcam."),
    ] = "stereo-page",
) -> None:
    """Print a rig file to begin with, e.g. unglare rigs template webcam > webcam.yaml."""
    from backend.devices.rig_templates import TEMPLATES

    if kind not in TEMPLATES:
        raise NotFoundError(f"There is no template {kind!r}; choose {', '.join(TEMPLATES)}.")
    typer.echo(TEMPLATES[kind], nl=False)


def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the rig.")],
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Show what a rig file says, and what is kept beside it; no device is opened."""
    quiet_logging()
    with answering(as_json) as answer:
        shelf = open_shelf(data)
        path = shelf.require(name)
        file = shelf.read(name)
        beside = [
            p
            for p in sorted(shelf.folder.glob(f"{name}.*"))
            if p != path and p.suffix != ".removed"
        ]
        answer.update(
            name=name,
            path=str(path),
            kept_beside=[str(p) for p in beside],
            rig=file.model_dump(mode="json"),
        )
        if not as_json:
            _show(name, path, beside, file)
        shelf.open(name, {})


def calibration(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="What cv2.FileStorage wrote of a stereo calibration of two cameras, or of a camera and the projector (one "
            "file or several); a capture.json; the calibration of another rig, or a part of one, e.g. its screen.",
        ),
    ],
    rig: Annotated[str, typer.Option(help="Name of a rig that is described by a file.")],
    cameras: Annotated[
        str,
        typer.Option(
            metavar="FIRST,SECOND",
            help="Which camera is OpenCV's first and which the second; the one that was calibrated with the projector."
            "  [default: as in the rig file]",
            show_default=False,
        ),
    ] = "",
    unit_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, help="Unit of T: 1000 for metres, or the size of the board's squares."
        ),
    ] = 1.0,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Size of the pictures, where no file says it.",
            show_default=False,
        ),
    ] = None,
    projector_size: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Size of the projector, where neither a file nor the rig's says it.",
            show_default=False,
        ),
    ] = None,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Keep a calibration that was made elsewhere for a rig; later scans with it end with points."""
    from backend.devices.rig_file import RigFile
    from backend.services.rig_calibration import StereoHints, in_frame_of, read_calibration

    quiet_logging()
    with answering(as_json) as answer:
        shelf = open_shelf(data)
        file = RigFile.read(shelf.require(rig))
        hints = StereoHints(
            _chosen(cameras, file),
            unit_mm,
            _pixels("--size", size),
            _pixels("--projector-size", projector_size) or file.display_px,
        )
        known = shelf.read(rig).calibration
        found = read_calibration(files, hints, known)
        entry = in_frame_of(found, file.reference_camera)
        path = shelf.keep_calibration(rig, entry, ", ".join(map(str, files)))
        answer.update(rig=rig, path=str(path), calibration=entry.model_dump(mode="json"))
        if not as_json:
            _show_calibration(entry)
            _say_lost(known, entry)
            console().print(f"kept in {path}; try it: unglare rigs check --rig {rig}")


def _chosen(cameras: str, file: "RigFile") -> list[str]:
    names = list(file.cameras)
    chosen = [part.strip() for part in cameras.split(",")] if cameras else names
    if len(set(chosen)) != len(chosen) or not set(chosen) <= set(names):
        raise InvalidSettingError(
            f"--cameras {cameras} has to name the rig's cameras: {', '.join(names)}."
        )
    return chosen


def _say_lost(before: "CalibrationEntry | None", now: "CalibrationEntry") -> None:
    for name in ("projector", "screen", "mirror"):
        if before is not None and getattr(before, name) and not getattr(now, name):
            console().print(
                f"The {name} that was calibrated before isn't kept: its place was said by cameras that are calibrated anew;"
                " name its file, too."
            )


def _pixels(option: str, text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InvalidSettingError(
            f"{option} {text} can't be read: write WIDTHxHEIGHT, e.g. 1280x1024."
        )
    return int(width), int(height)


def _show(name: str, path: Path, beside: list[Path], file: "RigFile") -> None:
    out = console()
    out.print(f"rig {name}{f', {file.title}' if file.title else ''}: {path}")
    rows = table("device", "driver", "options", "what is known of it")
    for camera, entry in file.cameras.items():
        known = [
            f"{k} {v}"
            for k, v in {**entry.sensor.model_dump(), **entry.limits.model_dump()}.items()
            if v is not None
        ]
        wired = [f"triggered on {entry.trigger_line}"] if entry.trigger_line else []
        role = ["reference"] if camera == file.reference_camera else []
        rows.add_row(
            camera, entry.driver, _options(entry.model_extra), ", ".join([*role, *wired, *known])
        )
    projector = file.projector
    rows.add_row(
        "projector", projector.driver, _options(projector.model_extra), f"gamma {projector.gamma:g}"
    )
    out.print(rows)
    if file.calibration is not None:
        _show_calibration(file.calibration)
    else:
        out.print("not calibrated: scans end with the phase, without points")
    for other in beside:
        out.print(f"beside it: {other}")


def _options(options: dict[str, Any] | None) -> str:
    return ", ".join(f"{key} {value}" for key, value in (options or {}).items())


def _show_calibration(calibration: "CalibrationEntry") -> None:
    rows = table("calibrated", ">size", ">focal length", ">principal point", ">from the reference")
    for name, view in calibration.views():
        rows.add_row(
            name, f"{view.width_px}x{view.height_px} px", f"{view.K[0][0]:.1f} px",
            f"{view.K[0][2]:.1f}, {view.K[1][2]:.1f} px", _distance(view.t_mm),
        )  # fmt: skip
    screen = calibration.screen
    if screen is not None:
        pitch = f"pitch {screen.pixel_pitch_mm:g} mm" if screen.pixel_pitch_mm else ""
        known = f"{len(screen.points)} points" if screen.points else pitch
        size = "x".join(map(str, screen.size_px)) + " px" if screen.size_px else ""
        rows.add_row("screen", size, known, "", _distance(screen.t_mm))
    if calibration.mirror is not None:
        rows.add_row("mirror", "", "", "", _distance(calibration.mirror.t_mm))
    console().print(rows)


def _distance(t_mm: tuple[float, float, float]) -> str:
    return f"{math.hypot(*t_mm):.2f} mm"
