"""Commands that may go on until Ctrl-C: events, logs, top."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import connection
from rosrm.cli.options import AsJson, Domain, Name
from rosrm.errors import NoMaster

if TYPE_CHECKING:
    from rosrm.core.views import Snapshot
    from rosrm.ros.client import MasterClient

#: Seconds between two looks.
PERIOD: Final = 0.5

Follow = Annotated[
    bool, typer.Option("--follow", "-f", help="Keep printing what is new until Ctrl-C.")
]


def events(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    follow: Follow = False,
    process: Annotated[
        str, typer.Option("--process", metavar="NAME", help="Show only events of this process.")
    ] = "",
    host: Annotated[
        str, typer.Option("--host", metavar="HOST", help="Show only events of this host.")
    ] = "",
    newest: Annotated[
        int, typer.Option("--newest", "-n", metavar="N", min=1, help="Show the newest N events.")
    ] = 100,
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Show events of the cluster, oldest first.

    With -f the command keeps printing; with --json too, each event is an object on its own line.
    """
    from rosrm.cli import json_forms, tables

    with connection.master(ctx, domain) as client:
        snapshot = client.list(events=True, process=process, host=host, newest=newest)
        connection.say_trouble(snapshot)
        if not snapshot.events:
            _check_names(client, process, host)
        console = tables.console()
        if as_json and not follow:
            json_forms.show(json_forms.forms(snapshot.events))
            return
        while True:
            for row in snapshot.events:
                if as_json:
                    json_forms.show_line(json_forms.form(row))
                elif console.is_terminal:
                    console.print(tables.event(row))
                else:
                    typer.echo(tables.event_line(row))
            if not follow:
                _say_left_out(len(snapshot.events), newest)
                return
            time.sleep(PERIOD)
            snapshot = _later(client, snapshot, process, host)


def _check_names(client: MasterClient, process: str, host: str) -> None:
    """Refuse the name of a process or host that the master does not know."""
    known = client.list(hosts=True, processes=True)
    connection.check_name("process", process, [row.name for row in known.processes])
    connection.check_name("host", host, [row.description.name for row in known.hosts])


def _say_left_out(shown: int, newest: int) -> None:
    if shown >= newest:
        typer.echo(f"rosrm: at most the newest {newest} are shown; -n N shows more", err=True)


def _later(client: MasterClient, before: Snapshot, process: str, host: str) -> Snapshot:
    return client.list(events=True, process=process, host=host, after=before.last_sequence)


def logs(
    ctx: typer.Context,
    name: Name,
    follow: Follow = False,
    tail: Annotated[
        str,
        typer.Option("--tail", metavar="SIZE", help="Only the end, such as 64kB."),
    ] = "",
    host: Annotated[
        str,
        typer.Option("--host", metavar="HOST", help="Of the instance on this host."),
    ] = "",
    domain: Domain = None,
) -> None:
    """Print what a process wrote.

    With -f also what it writes from now on, on whichever host, until it ends.
    """
    from rosrm.cli.log_following import bytes_of, copy_log

    end = bytes_of(tail)
    with connection.master(ctx, domain) as client:
        copy_log(client, name, host, end, follow=follow)


def top(
    ctx: typer.Context,
    period: Annotated[
        float, typer.Option("--period", metavar="SECONDS", min=0.1, help="Between two pictures.")
    ] = 1.0,
    count: Annotated[
        int, typer.Option("--count", "-n", metavar="N", min=0, help="End after N; 0: never.")
    ] = 0,
    domain: Domain = None,
) -> None:
    """Show a live table until Ctrl-C."""
    from rich.live import Live

    from rosrm.cli import live, tables

    with connection.master(ctx, domain) as client:
        snapshot, note, shown = _picture(client), "", 0
        with Live(console=tables.console(), auto_refresh=False) as screen:
            while True:
                rows = max(5, screen.console.height - 12 - len(snapshot.hosts))
                screen.update(live.render(snapshot, rows=rows, note=note), refresh=True)
                shown += 1
                if shown == count:
                    return
                time.sleep(period)
                try:
                    snapshot, note = _picture(client), ""
                except NoMaster:
                    note = "the master does not answer"


def _picture(client: MasterClient) -> Snapshot:
    return client.list(hosts=True, processes=True, events=True, newest=4)


COMMANDS: Final = (events, logs, top)
