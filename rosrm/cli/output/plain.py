"""Text for the terminal, as it can show it: the one place where commands print text.

Names, reasons and messages come from other hosts and other users. Tables go through
`tables.console`, which does the same.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from rosrm.cli.output.legible import legible
from rosrm.cli.process import INTERRUPTED
from rosrm.errors import RosrmError, ros_needed


def echo(text: str, *, err: bool = False) -> None:
    """Print a line to standard output, or to standard error."""
    typer.echo(legible(text, sys.stderr if err else sys.stdout), err=err)


@contextmanager
def errors_reported() -> Iterator[None]:
    """Turn an error of rosrm, and Ctrl-C, into a message and the exit code of the process."""
    try:
        with ros_needed():
            yield
    except RosrmError as error:
        echo(f"rosrm: {error}", err=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
