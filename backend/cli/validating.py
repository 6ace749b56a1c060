"""`unglare validate`: whether a method reaches its figures, on simulated chains with independent seeds."""

from typing import Annotated

import typer

from backend.cli.options import AsJson, Quiet
from backend.cli.output import ProgressLines, answering, quiet_logging
from backend.cli.reports import Out, show_report, written_report

_validations = typer.Typer(
    name="validate",
    help="Tables that show whether a method reaches its figures; writes CSV, pictures and a page.",
    no_args_is_help=True,
)


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.add_typer(_validations)


@_validations.callback()
def _group() -> None:
    """Keep `reflection` a command of its own name as long as it is the only one."""


@_validations.command(name="reflection")
def reflection(
    out: Out = None,
    chain: Annotated[
        list[str] | None, typer.Option(help="Letter of a chain, B to G; repeatable. All of them.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Independent calibrations.")] = 3,
    first_seed: Annotated[int, typer.Option(min=0, help="Number of the first one.")] = 1,
    phases: Annotated[int, typer.Option(min=100, max=10**6, help="Fringes per number.")] = 20_000,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell the phase error of every chain and representation, over all phases and at the paper's three lines."""
    quiet_logging()
    from backend.services.reflection_validation import known_letters, reflection_validation
    from backend.services.report_document import refuse_report_folder

    with answering(as_json) as answer, ProgressLines(hidden=quiet) as progress:
        letters = known_letters(chain)
        if out is not None:
            refuse_report_folder(out)
        report = reflection_validation(
            letters=letters,
            seeds=range(first_seed, first_seed + seeds),
            phases=phases,
            progress=lambda done, text="": progress.step(text, done),
        )
        progress.finish()
        answer.update(written_report(report, out))
    if not as_json:
        show_report(report, out)
