"""`unglare rigs check`: are all devices there, and do they see light."""

from typing import TYPE_CHECKING

from backend.cli.house import Monitor, open_services
from backend.cli.options import (
    AsJson,
    DataFolder,
    RigName,
    RigOptions,
    Scene,
    Seed,
    Size,
    parse_rig_options,
)
from backend.cli.output import answering, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.services.rig_trial import RigTrial


def check_rig(
    rig: RigName = "simulated",
    scene: Scene = None,
    size: Size = None,
    seed: Seed = None,
    rig_options: RigOptions = None,
    monitor: Monitor = None,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Open a rig, show its devices, and take one test frame with each camera."""
    from backend.services.rig_trial import try_rig

    quiet_logging()
    with answering(as_json) as answer:
        options = parse_rig_options(rig_options, scene=scene, size=size, seed=seed)
        with open_services(data, rig=rig, monitor=monitor) as services:
            found = try_rig(services.context, rig, options)
        answer.update(found.document())
        if not as_json:
            _show(found)
        if found.problems:
            answer["error"] = found.problems[0]


def _show(found: "RigTrial") -> None:
    out = console()
    out.print(f"rig {found.name}: {found.info}")
    rows = table("device", "who", "what")
    for device in found.devices:
        rows.add_row(device.name, device.who, device.abilities)
    out.print(rows)
    frames = table("camera", ">size", ">bits", ">exposure", ">mean", ">brightest", ">saturated")
    for frame in found.frames:
        frames.add_row(
            frame.camera,
            f"{frame.width_px}x{frame.height_px}",
            str(frame.bits),
            f"{frame.exposure_ms:.2f} ms",
            f"{frame.mean_gray:.1f}",
            f"{frame.brightest_gray:.0f}",
            f"{frame.saturated_share:.2%}",
        )
    out.print(frames)
    out.print(found.calibration)
    for note in found.notes:
        out.print(f"note: {note}")
    for problem in found.problems:
        out.print(f"problem: {problem}")
    if not found.problems:
        out.print("no problems found")
