"""`unglare rigs discover`: which cameras are there, and the line that a rig file needs for each."""

from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.options import AsJson, DataFolder
from backend.cli.output import answering, complain, console, quiet_logging, table

if TYPE_CHECKING:
    from backend.devices.found import FoundCamera


def discover(
    addresses: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ADDRESS",
            help="IPv4 addresses of GigE Vision cameras.  [default: those in the station's rig files]",
            show_default=False,
        ),
    ] = None,
    search: Annotated[
        bool,
        typer.Option(
            "--search",
            help="Let every installed driver look for cameras. GigE Vision drivers do that by broadcast: every "
            "device on every network of this computer hears it.",
        ),
    ] = False,
    data: DataFolder = None,
    as_json: AsJson = False,
) -> None:
    """Ask known addresses which cameras are there; nothing is broadcast unless --search is given."""
    from backend.devices import discovery
    from backend.devices.pages import PageDesk
    from backend.devices.rig_shelf import RigShelf
    from backend.domain.errors import InvalidSettingError
    from backend.settings import load_settings

    quiet_logging()
    with answering(as_json) as answer:
        shelf = RigShelf(load_settings(data_folder=data).rig_folder, PageDesk())
        if addresses and search:
            raise InvalidSettingError(
                "give addresses or --search, not both: known addresses are asked without searching"
            )
        asked = list(addresses or discovery.known_addresses(shelf))
        if not (asked or search):
            raise InvalidSettingError(
                "no rig file names an address to ask; give addresses, or --search to look for all by broadcast"
            )
        if search:
            result = discovery.search()
            found, problems = result.cameras, result.problems
        else:
            found, problems = discovery.ask_known(shelf, asked), ()
        silent = [a for a in asked if a not in {camera.address for camera in found}]
        answer.update(
            cameras=[_document(camera) for camera in found],
            silent=[] if search else silent,
            problems=list(problems),
        )
        if not as_json:
            _show(found)
    for address in answer["silent"]:
        complain(discovery.why_silent(address))
    for problem in problems:
        complain(problem)


def _show(found: "tuple[FoundCamera, ...]") -> None:
    if not found:
        console().print("no cameras found")
        return
    rows = table("", "camera", "at", "controlled by", "used in")
    for number, camera in enumerate(found, 1):
        rows.add_row(
            f"camera{number}",
            _who(camera),
            camera.address or "-",
            {None: "not known", "": "nobody"}.get(camera.controlled_by, camera.controlled_by),
            ", ".join(camera.used_in) or "-",
        )
    out = console()
    out.print(rows)
    out.print("for a rig file, with names of your choice:\ncameras:")
    for number, camera in enumerate(found, 1):
        out.print(f"  camera{number}: {camera.rig_line}", markup=False)


def _who(camera: "FoundCamera") -> str:
    serial = f" ({camera.serial})" if camera.serial else ""
    return f"{camera.vendor} {camera.model}".strip() + serial


def _document(camera: "FoundCamera") -> dict[str, object]:
    return {
        "driver": camera.driver,
        "options": dict(camera.options),
        "vendor": camera.vendor,
        "model": camera.model,
        "serial": camera.serial,
        "address": camera.address,
        "controlled_by": camera.controlled_by,
        "used_in": list(camera.used_in),
        "rig_line": camera.rig_line,
    }
