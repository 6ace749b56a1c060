"""The services of a command: the composition root's, with everything in this process."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from backend.cli.output import ProgressLines
    from backend.services.services import Services


@contextlib.contextmanager
def open_services(
    data: Path | None, progress: "ProgressLines | None" = None
) -> "Iterator[Services]":
    """Open the services for one command.

    Parameters
    ----------
    data
        Data folder; None: as the environment says.
    progress
        Is told of every job's progress.
    """
    from backend.contract.events import Event
    from backend.jobs.execution import Workshop
    from backend.jobs.runner import InlineRunner, Runner
    from backend.main import build_services
    from backend.settings import load_settings

    def make_runner(shop: Workshop) -> Runner:
        if progress is None:
            return InlineRunner(shop)
        bars, publish = progress, shop.publish

        def tell(event: Event) -> None:
            publish(event)
            bars.tell(event)

        return InlineRunner(replace(shop, publish=tell))

    with contextlib.closing(
        build_services(load_settings(data_folder=data), make_runner=make_runner)
    ) as services:
        yield services


def who() -> str:
    """Return who gives the commands, for the audit trail."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may run as a user without a name
        return "command line"
