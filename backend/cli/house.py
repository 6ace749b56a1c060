"""The services of a command: the composition root's, with everything in this process.

Where a rig shows its patterns in a projector page, the command serves that page itself and waits until it is open.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlencode

import typer

from backend.domain.errors import (
    InvalidSettingError,
    StageFailedError,
    StartupError,
    UnglareError,
)

if TYPE_CHECKING:
    from backend.cli.output import ProgressLines
    from backend.jobs.execution import Workshop
    from backend.jobs.runner import Runner
    from backend.services.services import Services
    from backend.settings import Settings

Monitor = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Open the rig's projector page on this monitor, see unglare projector --list; else open it yourself.",
        show_default=False,
    ),
]

_OPENING_S = 600.0
"""How long an operator may take to open the projector page."""


@contextlib.contextmanager
def open_services(
    data: Path | None,
    progress: "ProgressLines | None" = None,
    *,
    rig: str = "",
    monitor: int | None = None,
) -> "Iterator[Services]":
    """Open the services for one command.

    Parameters
    ----------
    data
        Data folder; None: as the environment says.
    progress
        Is told of every job's progress.
    rig
        The rig that the command uses: if it shows its patterns in a page, that is open afterwards.
    monitor
        Where to open that page; None: the operator does it.

    Raises
    ------
    StartupError
        If the page can't be served: a server has it.
    StageFailedError
        If nobody opens the page.
    """
    from backend.main import build_services
    from backend.settings import load_settings

    settings, make_runner = load_settings(data_folder=data), _runner_telling(progress)
    page = _page_of(settings, rig)
    if page is not None:
        with _services_with_page(settings, make_runner, rig, page, monitor) as services:
            yield services
        return
    if monitor is not None:
        raise InvalidSettingError(
            f"--monitor {monitor} is for rigs with a projector page, rig {rig or 'simulated'} has none; leave it out"
        )
    with contextlib.closing(build_services(settings, make_runner=make_runner)) as services:
        yield services


def _page_of(settings: "Settings", rig: str) -> str | None:
    """Return the projector page that a rig's file names; what is wrong with the file is said when it is opened."""
    from backend.devices.pages import PageDesk
    from backend.devices.rig_file import RigFile
    from backend.devices.rig_shelf import RigShelf

    path = {kept.name: kept.path for kept in RigShelf(settings.rig_folder, PageDesk()).kept()}.get(
        rig
    )
    try:
        return RigFile.read(path).page if path else None
    except UnglareError:
        return None


@contextlib.contextmanager
def _services_with_page(
    settings: "Settings",
    make_runner: "Callable[[Workshop], Runner]",
    rig: str,
    page: str,
    monitor: int | None,
) -> "Iterator[Services]":
    from backend.main import is_served, serve_pages
    from backend.services.kiosk import Kiosk, listed_monitors

    if is_served(settings.data_folder):
        raise StartupError(
            f"Rig {rig} shows its patterns in projector page {page!r}, and a server runs on {settings.data_folder}: the"
            " page is with that one. Use the rig there, in the browser or by the API, or stop the server first."
        )
    kiosk = Kiosk(settings.data_folder / "kiosk" / "of-commands")  # which are alone in the folder
    chosen = kiosk.choose(listed_monitors(), monitor) if monitor is not None else None
    if chosen is not None:  # nobody types the address: another program may have the usual port
        settings = settings.model_copy(update={"port": 0})
    said: list[tuple[str, str]] = []
    with (
        serve_pages(
            settings, announce=lambda *door: said.append(door), make_runner=make_runner
        ) as (services, pages),
        contextlib.ExitStack() as shown,
    ):
        address, token = said[0]
        if chosen is not None:
            typer.echo(f"The projector page {page!r} is shown on monitor {chosen}.", err=True)
            shown.enter_context(kiosk.opened(chosen, address, name=page, token=token))
        else:
            link = f"{address}/projector?{urlencode({'token': token, 'name': page})}"
            typer.echo(
                "Open this page full screen on the projector's monitor, or give --monitor NUMBER:\n    "
                f"{link}",
                err=True,
            )
        if pages.find(page, _OPENING_S) is None:
            raise StageFailedError(
                f"No projector page {page!r} was opened within {_OPENING_S:g} s: open it full screen, then run this again."
            )
        yield services


def _runner_telling(progress: "ProgressLines | None") -> "Callable[[Workshop], Runner]":
    """Return what makes the runner of a command: in this process, with progress where that is wanted."""
    from backend.contract.events import Event
    from backend.jobs.runner import InlineRunner

    def make_runner(shop: "Workshop") -> "Runner":
        if progress is None:
            return InlineRunner(shop)
        bars, publish = progress, shop.publish

        def tell(event: Event) -> None:
            publish(event)
            bars.tell(event)

        return InlineRunner(replace(shop, publish=tell))

    return make_runner


def who() -> str:
    """Return who gives the commands, for the audit trail."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may run as a user without a name
        return "command line"
