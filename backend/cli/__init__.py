"""The command line: the same services as behind the browser, without one. One module per group of commands."""

import sys


def main() -> None:
    """Run the command line: the entry point `unglare`."""
    from backend.cli.application import (
        run,  # typer takes its time: not for whoever only imports the package
    )

    sys.exit(run(sys.argv[1:]))
