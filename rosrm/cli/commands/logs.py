"""Commands about the output of processes: logs."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import completion, connection
from rosrm.cli.options import Application, Domain
from rosrm.errors import ConfigError, Refused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rosrm.cli.output.log_search import LineSearch
    from rosrm.client.client import Client


def logs(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...", help="Names of processes.", autocompletion=completion.processes
        ),
    ] = None,
    app: Application = "",
    follow: Annotated[
        bool,
        typer.Option("--follow", "-f", help="Print new output until the processes have ended."),
    ] = False,
    tail: Annotated[
        int | None,
        typer.Option(
            "--tail", metavar="N", min=1, help="Print only the last N lines of each process."
        ),
    ] = None,
    since: Annotated[
        str,
        typer.Option(
            "--since",
            metavar="TIME",
            help="Print only output of the last TIME, e.g. 10min, or since 2026-11-27T09:30.",
        ),
    ] = "",
    until: Annotated[
        str,
        typer.Option("--until", metavar="TIME", help="Print only output up to TIME, as --since."),
    ] = "",
    grep: Annotated[
        str,
        typer.Option(
            "--grep",
            metavar="REGEX",
            help="Print only lines with this regular expression, e.g. 'battery|motor'.",
        ),
    ] = "",
    level: Annotated[
        str,
        typer.Option(
            "--level",
            metavar="LEVEL",
            help="Print only lines of this level or above: debug, info, warn, error or fatal.",
        ),
    ] = "",
    timestamps: Annotated[
        bool,
        typer.Option(
            "--timestamps", "-t", help="Begin each line with its time, by the clock of its host."
        ),
    ] = False,
    host: Annotated[
        str,
        typer.Option(
            "--host",
            metavar="HOST",
            help="Print only output from this host.",
            autocompletion=completion.hosts,
        ),
    ] = "",
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Print colours and other control characters in a terminal too."),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each line as a JSON object.")
    ] = False,
    domain: Domain = None,
) -> None:
    """Print the output of processes, from all hosts.

    The output is complete over restarts and moves. Where the size limit of logs dropped output, a
    line gives the dropped size. In a terminal, lines have the colour of their level, and control
    characters are printed as numbers; into a file or pipe the output is copied as it is.
    """
    from rosrm.cli.log_copies import copy_logs, time_of
    from rosrm.cli.output.log_lines import LogStream, is_terminal
    from rosrm.client.logs import LogSelection

    if follow and until:
        raise ConfigError("--until: -f continues without an end; give one of the two")
    is_plain = raw or not is_terminal()
    search = _search(
        grep, level, time_of("--until", until), as_json=as_json,
        coloured=not is_plain and not os.environ.get("NO_COLOR"),
    )  # fmt: skip
    selection = LogSelection(tail or 0, time_of("--since", since), host, follow)
    with connection.master(ctx, domain) as client:
        chosen = _names(client, names or (), app)
        width = max(map(len, chosen)) if len(chosen) > 1 else 0
        streams = [
            LogStream(
                name, f"{name:<{width}} | ".encode() if width else b"", timestamps, is_plain, search
            )
            for name in chosen
        ]
        copy_logs(client, streams, selection)


def _search(
    grep: str, level: str, until: float, *, as_json: bool, coloured: bool
) -> LineSearch | None:
    """Return the search for lines; None: bytes are copied as they are."""
    from rosrm.cli.output.log_levels import level_named
    from rosrm.cli.output.log_search import LineSearch, pattern_of

    search = LineSearch(
        pattern_of("--grep", grep) if grep else None,
        level_named("--level", level) if level else None, until, as_json, coloured,
    )  # fmt: skip
    return None if search == LineSearch() else search


def _names(client: Client, names: Sequence[str], app: str) -> Sequence[str]:
    """Return the processes of a command; raises `ConfigError` and `Refused`."""
    if bool(names) == bool(app):
        raise ConfigError("give the names of processes, or an application: --app APP")
    if not app:
        return list(dict.fromkeys(names))
    found = [row.name for row in client.list_processes() if row.application == app]
    if not found:
        client.get_application(app)  # refuses an unknown name with the nearest one
        raise Refused(f"the application {app} has no processes")
    return found


COMMANDS: Final = (logs,)
