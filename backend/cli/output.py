"""What commands show: progress and sentences on the error output, answers on the output."""

import contextlib
import json
import logging
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import typer

from backend.domain.errors import CancelledError, UnglareError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from backend.contract.events import Event

Document = dict[str, Any]

FAILED = 1
CANCELLED = 130
"""As a shell reports a program that Ctrl+C ended."""
_WIDTH_OF_FILES = 140


@contextlib.contextmanager
def answering(as_json: bool) -> Iterator[Document]:
    """Collect a command's answer and print it last, also when the command fails.

    With `as_json` the answer is printed as one JSON object, with `error` in it where something went wrong.
    An answer that holds an `error` already makes the command fail.
    """
    answer: Document = {}
    status = 0
    try:
        yield answer
        if answer.get("error"):
            status = FAILED
    except CancelledError as error:
        answer["error"], status = error.sentence, CANCELLED
    except KeyboardInterrupt:
        answer["error"] = "Cancelled: what is finished and captured is kept."
        status = CANCELLED
    except UnglareError as error:
        answer["error"], status = error.sentence, FAILED
    if as_json:
        sys.stdout.write(json.dumps(answer, ensure_ascii=False, default=str) + "\n")
    if status:
        complain(answer["error"])
        raise typer.Exit(status)


def complain(sentence: str) -> None:
    """Say one sentence on the error output."""
    typer.echo(f"unglare: {sentence}", err=True)


def console(*, errors: bool = False) -> "Console":
    """Return where texts and tables go; a file or pipe gets wide ones."""
    from rich.console import Console

    is_terminal = (sys.stderr if errors else sys.stdout).isatty()
    width = None if is_terminal else _WIDTH_OF_FILES
    return Console(stderr=errors, soft_wrap=True, highlight=False, width=width)


def table(*columns: str, title: str | None = None) -> "Table":
    """Make a table; a column whose name starts with `>` is aligned to the right."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, title_justify="left", box=box.SIMPLE)
    for name in columns:
        made.add_column(name.removeprefix(">"), justify="right" if name.startswith(">") else "left")
    return made


class ProgressLines:
    """One progress bar per stage, on the error output."""

    def __init__(self, *, hidden: bool = False) -> None:
        from rich.progress import (
            BarColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
        )

        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}"),
            console=console(errors=True),
            disable=hidden,
        )
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> "ProgressLines":
        """Show the bars."""
        self._bars.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Leave the bars as they are."""
        for task in self._tasks.values():
            self._bars.stop_task(task)
        self._bars.stop()

    def tell(self, event: "Event") -> None:
        """Follow a job; may be called from any thread."""
        from backend.contract.events import JobProgress

        if isinstance(event, JobProgress) and event.job.stage:
            self.step(event.job.stage, event.job.progress, event.job.text, event.job.remaining_s)

    def step(
        self, name: str, done: float, text: str = "", remaining_s: float | None = None
    ) -> None:
        """Set one bar; the bars before it are complete."""
        if name not in self._tasks:
            self._complete()
            self._tasks[name] = self._bars.add_task(name, total=1.0, text="")
        remaining = f", {remaining_s:.0f} s left" if remaining_s and remaining_s >= 1 else ""
        self._bars.update(self._tasks[name], completed=done, text=f"{text}{remaining}")

    def finish(self) -> None:
        """Complete the last bar."""
        self._complete()

    def part(self, name: str) -> Any:
        """Return a `Progress` function that moves one bar."""

        def tell(done: float, text: str = "") -> None:
            self.step(name, done, text)

        return tell

    def _complete(self) -> None:
        for task in self._tasks.values():
            if not self._bars.tasks[task].finished:
                self._bars.update(task, completed=1.0, text="")
                self._bars.stop_task(task)


def quiet_logging() -> None:
    """Leave the error output to progress and sentences; defects still come with their traceback."""
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s %(name)s: %(message)s")
