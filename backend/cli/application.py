"""All commands together, and how they end."""

from typing import Annotated

import typer

from backend.cli import (
    benchmarking,
    calibrating,
    captures,
    comparing,
    describing,
    drivers,
    pattern_sets,
    projecting,
    reflecting,
    reports,
    rigs,
    scanning,
    serving,
    simulating,
    validating,
)
from backend.cli.output import CANCELLED, FAILED
from backend.domain.errors import CancelledError, UnglareError

application = typer.Typer(
    name="unglare",
    help="Measure shiny, black and mirror-like parts by structured light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (
    serving,
    scanning,
    captures,
    calibrating,
    describing,
    drivers,
    projecting,
    pattern_sets,
    comparing,
    reflecting,
    reports,
    rigs,
    simulating,
    validating,
    benchmarking,
):
    group.register(application)


def _version(wanted: bool | None) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"unglare {version('unglare')}")
        raise typer.Exit


@application.callback()
def _options(
    version: Annotated[
        bool | None,  # None: what typer passes on when the option has had its callback
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = None,
) -> None:
    """Take the options that all commands have."""


def run(arguments: list[str]) -> int:
    """Run one command and return its exit status; an expected error is one sentence, without traceback."""
    try:
        status = application(arguments, prog_name="unglare", standalone_mode=False)
    except typer.Abort:
        return _refuse("Cancelled.", CANCELLED)
    except KeyboardInterrupt:
        return _refuse("Cancelled: what is finished and captured is kept.", CANCELLED)
    except CancelledError as error:
        return _refuse(error.sentence, CANCELLED)
    except UnglareError as error:
        return _refuse(error.sentence, FAILED)
    except Exception as error:
        if not hasattr(error, "exit_code") or not hasattr(error, "show"):
            raise
        error.show()  # a wrong option: typer says which and what there is
        return int(error.exit_code)
    return status if isinstance(status, int) else 0


def _refuse(sentence: str, status: int) -> int:
    typer.echo(f"unglare: {sentence}", err=True)
    return status
