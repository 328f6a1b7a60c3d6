"""Commands about the output of processes: logs, collect-logs."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, cast

import typer

from rosrm.cli import connection
from rosrm.cli.options import Application, CommonOptions, Domain, SomeNames, host_option
from rosrm.errors import ConfigError, Refused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rosrm.archive.reader import LogArchive
    from rosrm.cli.output.log_search import LineSearch
    from rosrm.client.client import Client
    from rosrm.ros.master_connection import MasterClient


Archive = Annotated[
    Path | None,
    typer.Option(
        "--archive",
        metavar="DIR",
        envvar="ROSRM_LOG_ARCHIVE",
        help="Directory of `rosrm collect-logs`, for the output of hosts that are gone.",
    ),
]


def logs(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    names: SomeNames = None,
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
    host: Annotated[str, host_option("Print only output from this host.")] = "",
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Print colours and other control characters in a terminal too."),
    ] = False,
    archive: Archive = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each line as a JSON object.")
    ] = False,
    domain: Domain = None,
) -> None:
    """Print the output of processes, from all hosts.

    With a log archive, the output of hosts that are gone is printed too.

    The output is complete over restarts and moves. Where the size limit of logs dropped output, a
    line gives the dropped size. In a terminal, lines have the colour of their level, and control
    characters are printed as numbers; into a file or pipe the output is copied as it is.
    """
    from rosrm.cli.log_copies import copy_logs, time_of
    from rosrm.cli.output.log_lines import LogStream, is_terminal
    from rosrm.client.logs import LogSelection

    if follow and until:
        raise ConfigError("--until: -f prints output without an end; give either -f or --until")
    is_plain = raw or not is_terminal()
    search = _search(
        grep, level, time_of("--until", until), as_json=as_json,
        coloured=not is_plain and not os.environ.get("NO_COLOR"),
    )  # fmt: skip
    selection = LogSelection(tail or 0, time_of("--since", since), host, follow)
    collected = open_archive(archive)
    with _client(ctx, domain, app, has_archive=collected is not None) as client:
        chosen = _names(client, names or (), app)
        width = max(map(len, chosen)) if len(chosen) > 1 else 0
        streams = [
            LogStream(
                name, f"{name:<{width}} | ".encode() if width else b"", timestamps, is_plain, search
            )
            for name in chosen
        ]
        copy_logs(client, streams, selection, collected)


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


def open_archive(directory: Path | None) -> LogArchive | None:
    """Open the log archive of a command, if one is given; raises `Refused`."""
    from rosrm.archive.reader import LogArchive

    return None if directory is None else LogArchive(directory)


@contextmanager
def _client(
    ctx: typer.Context, domain: int | None, app: str, *, has_archive: bool
) -> Iterator[Client]:
    """Create a client of the master; with an archive, the master may be gone."""
    from rosrm.client.client import Client
    from rosrm.client.no_master import NoConnection
    from rosrm.errors import NoMaster

    with ExitStack() as closing:
        try:
            client = closing.enter_context(connection.master(ctx, domain))
        except NoMaster as error:
            if not has_archive:
                raise
            if app:
                hint = "Without a master, give the names of the processes in place of --app"
                raise NoMaster(f"{error}. {hint}") from None
            connection.note(f"only collected logs are printed: {error}")
            no_master = cast("MasterClient", NoConnection())
            client = Client(connection=no_master, notify=connection.note)
        yield client


def collect_logs(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Directory of the log archive, of one cluster.")
    ],
    every: Annotated[
        str,
        typer.Option(
            "--every",
            metavar="TIME",
            help="Time between two requests for a log with new output, e.g. 5s.",
        ),
    ] = "2s",
    keep: Annotated[
        str,
        typer.Option("--keep", metavar="SIZE", help="Largest size of the archive, e.g. 100GB."),
    ] = "20GB",
    keep_host: Annotated[
        str,
        typer.Option("--keep-host", metavar="SIZE", help="Largest size of the logs of one host."),
    ] = "5GB",
    max_rate: Annotated[
        str,
        typer.Option("--max-rate", metavar="SIZE", help="Most bytes per second, e.g. 1MB."),
    ] = "5MB",
    domain: Domain = None,
) -> None:
    """Copy the output of all processes into a log archive until Ctrl-C.

    `rosrm logs --archive DIR` reads the archive when a host is gone. The command continues where it
    stopped, also after it was killed.
    """
    from rosrm.archive.retention import ArchiveLimits
    from rosrm.cli.collecting import collect
    from rosrm.cli.options import seconds_of, size_of

    limits = ArchiveLimits(
        size_of("--keep", keep, low=1_000_000), size_of("--keep-host", keep_host, low=1_000_000)
    )
    cluster = ctx.obj.cluster if isinstance(ctx.obj, CommonOptions) else None
    collect(
        directory, limits, connection.ros_settings(ctx, domain), cluster,
        every=seconds_of("--every", every, low=0.1, above=False),
        rate=size_of("--max-rate", max_rate, low=1000),
    )  # fmt: skip


COMMANDS: Final = (logs, collect_logs)
