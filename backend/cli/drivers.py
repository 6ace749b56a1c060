"""`unglare drivers`: what the entries of a rig file may name, and which options each takes."""

from typing import TYPE_CHECKING, Annotated

import typer

from backend.cli.options import AsJson
from backend.cli.output import answering, console, quiet_logging, table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from backend.services.driver_list import ListedDriver


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(drivers)


def drivers(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Show the options of this driver.", show_default=False),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """List the drivers of cameras and projectors, whether they can be used, and what they take in a rig file."""
    from dataclasses import asdict

    from backend.services.driver_list import list_drivers

    quiet_logging()
    with answering(as_json) as answer:
        found = list_drivers(name)
        answer["drivers"] = [asdict(driver) for driver in found]
        if not as_json and name:
            _show_options(found)
        elif not as_json:
            _show(found)


def _show(found: "Iterable[ListedDriver]") -> None:
    rows = table("driver", "of", "from", "options", "")
    for driver in found:
        options = " ".join(o.name if o.required else f"[{o.name}]" for o in driver.options)
        rows.add_row(
            driver.name, driver.kind, driver.package, _plain(options), driver.problem or "ready"
        )
    console().print(rows)
    console().print("unglare drivers NAME tells what a driver's options mean.")


def _show_options(found: "Iterable[ListedDriver]") -> None:
    out = console()
    for driver in found:
        out.print(f"{driver.kind} driver {driver.name} of {driver.package}: {_plain(driver.title)}")
        out.print(driver.problem or "ready")
        rows = table("option", "value", "default", "")
        for option in driver.options:
            default = (
                "required"
                if option.required
                else ""
                if option.default is None
                else str(option.default)
            )
            rows.add_row(option.name, _plain(option.values), _plain(default), _plain(option.text))
        out.print(rows)


def _plain(text: str) -> str:
    """Keep rich from taking brackets for its markup."""
    from rich.markup import escape

    return escape(text)
