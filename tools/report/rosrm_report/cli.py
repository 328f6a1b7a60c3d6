"""`rosrm report`: a whole run as one HTML file."""

# The command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rosrm.cli.options import AsJson


def report(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A directory such as out/demo or a master's state, a journal, or a record.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="HTML file to write; replaces an older one."
        ),
    ] = Path("report.html"),
    title: Annotated[
        str,
        typer.Option(
            "--title", metavar="TEXT", help="Title of the page; default: name of the source."
        ),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Write a report of a whole run: one HTML file that opens without a network.

    With --json the numbers are printed, and no file is written.
    """
    from rosrm.cli.output.plain import echo
    from rosrm_report.page import summary
    from rosrm_report.writing import read_report, write_page

    made = read_report(source, title)
    if as_json:
        from rosrm.cli.output.json_forms import show
        from rosrm.model.codec import to_plain

        show(to_plain(made))
        return
    write_page(made, output)
    echo(f"{output}: {summary(made)}")
    for note in made.notes:
        echo(note, err=True)
