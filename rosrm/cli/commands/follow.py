"""Commands that can run until Ctrl-C: events, top."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import completion, connection
from rosrm.cli.options import AsJson, Domain, host_option, seconds_of
from rosrm.cli.output.plain import echo
from rosrm.client.connecting import check_name
from rosrm.wording import counted

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import EventRow

#: Number of events that are shown, and of those that are written to a file, by default.
_SHOWN: Final = 100
_ALL_EVENTS: Final = 2**32 - 1


def events(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Print new events until Ctrl-C.")
    ] = False,
    process: Annotated[
        str,
        typer.Option(
            "--process",
            metavar="NAME",
            help="Show only events of this process.",
            autocompletion=completion.processes,
        ),
    ] = "",
    host: Annotated[str, host_option("Show only events of this host.")] = "",
    newest: Annotated[
        int | None,
        typer.Option(
            "--newest",
            "-n",
            metavar="N",
            min=1,
            help="Show the newest N events; default: 100, and all with --mcap.",
        ),
    ] = None,
    mcap: Annotated[
        Path | None,
        typer.Option(
            "--mcap",
            metavar="FILE",
            help="Write the events to a new MCAP file, for Foxglove or Lichtblick.",
        ),
    ] = None,
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Show events of the cluster, oldest first.

    With -f the command keeps printing; with --json too, each event is an object on its own line.
    """
    from rosrm.cli.output import json_forms, reader, tables

    if mcap is not None:
        with connection.master(ctx, domain) as client:
            rows = client.events(
                process=process, host=host, newest=newest or _ALL_EVENTS, follow=follow
            )
            _write_mcap(mcap, rows)
        return
    newest = newest or _SHOWN
    with connection.master(ctx, domain) as client:
        snapshot = client.list(events=True, process=process, host=host, newest=newest)
        connection.print_trouble(snapshot)
        if not snapshot.events:
            _check_names(client, process, host)
        console = tables.console()
        if as_json and not follow:
            json_forms.show(json_forms.forms(snapshot.events))
            return

        def show(row: EventRow) -> None:
            if as_json:
                json_forms.show_line(json_forms.form(row))
            elif console.is_terminal:
                console.print(tables.event(row))
            else:
                echo(tables.event_line(row))

        for row in snapshot.events:
            show(row)
        if not follow:
            _say_left_out(len(snapshot.events), newest)
            return
        after = snapshot.last_sequence
        with reader.needed():
            for row in client.events(process=process, host=host, after=after, follow=True):
                show(row)


def _write_mcap(path: Path, rows: Iterable[EventRow]) -> None:
    """Write events to a new MCAP file, until they end or Ctrl-C."""
    from rosrm.extensions.registry import Registry
    from rosrm.model.notices import notice_of

    written = 0
    with Registry.discover().sink("mcap", {"file": str(path)}) as sink:
        try:
            for row in rows:
                sink.send([notice_of(row)])
                written += 1
        finally:
            echo(f"{counted(written, 'event')} written to {path}", err=True)


def _check_names(client: Client, process: str, host: str) -> None:
    """Refuse the name of a process or host that the master does not know."""
    known = client.list(hosts=True, processes=True)
    check_name("process", process, [row.name for row in known.processes])
    check_name("host", host, [row.description.name for row in known.hosts])


def _say_left_out(shown: int, newest: int) -> None:
    if shown >= newest:
        echo(f"rosrm: at most the newest {newest} are shown; -n N shows more", err=True)


def top(
    ctx: typer.Context,
    period: Annotated[
        str,
        typer.Option("--period", metavar="TIME", help="Time between two updates, e.g. 2s."),
    ] = "1s",
    count: Annotated[
        int,
        typer.Option(
            "--count",
            "-n",
            metavar="N",
            min=0,
            help="Exit after N updates; 0: only on q or Ctrl-C.",
        ),
    ] = 0,
    sort: Annotated[
        str,
        typer.Option("--sort", metavar="KEY", help="Order: state, cpu, memory or name."),
    ] = "state",
    domain: Domain = None,
) -> None:
    """Show a live table until q or Ctrl-C.

    In a terminal the keys s, c, m and n sort the processes by state, CPU, memory and name.
    """
    from rosrm.cli.output import top_screen

    seconds = seconds_of("--period", period, low=top_screen.LEAST_PERIOD, above=False)
    order = top_screen.sort_of(sort)
    with connection.master(ctx, domain) as client:
        top_screen.show(
            partial(client.list, hosts=True, processes=True, events=True, newest=4),
            seconds, count, order,
        )  # fmt: skip


COMMANDS: Final = (events, top)
