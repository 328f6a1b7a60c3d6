"""Text for the terminal, without control characters: the one place where commands print text.

Names, reasons and messages come from other hosts and other users. Tables go through
`tables.console`, which does the same.
"""

from __future__ import annotations

import typer

from rosrm.wording import printable


def echo(text: str, *, err: bool = False) -> None:
    """Print a line to standard output, or to standard error."""
    typer.echo(printable(text), err=err)
