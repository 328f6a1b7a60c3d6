"""Commands that print once: status, ps, hosts, plugins, explain."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rosrm.cli import connection
from rosrm.cli.options import Application, Array, AsJson, Domain, Name, host_option
from rosrm.cli.output.plain import echo
from rosrm.client.connecting import check_name
from rosrm.errors import Refused
from rosrm.wording import few

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import HostRow

#: Most hosts of which one listing explains why processes have to leave them.
_MOST_EXPLAINED: Final = 4


def status(ctx: typer.Context, as_json: AsJson = False, domain: Domain = None) -> None:
    """Show an overview: hosts, processes, problems, newest events."""
    from rosrm.cli.output import json_forms
    from rosrm.cli.output import status as overview
    from rosrm.cli.output.tables import show

    with connection.master(ctx, domain) as client:
        snapshot = client.list(hosts=True, processes=True, plugins="failing", events=True, newest=5)
        to_leave = _to_leave(client, snapshot.hosts)
    connection.print_trouble(snapshot)
    if as_json:
        json_forms.show({**json_forms.status_form(snapshot), "to_leave": to_leave})
    else:
        show(overview.render(snapshot, to_leave))


def ps(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    everything: Annotated[
        bool, typer.Option("--all", "-a", help="List finished and cancelled processes too.")
    ] = False,
    host: Annotated[str, host_option("List only processes on this host.")] = "",
    array: Array = "",
    application: Application = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """List the processes; of an array with a summary."""
    from rosrm.cli.output import arrays, json_forms, tables

    with connection.master(ctx, domain) as client:
        snapshot = client.list(processes=True, hosts=bool(host), applications=bool(application))
    connection.print_trouble(snapshot)
    check_name("host", host, [row.description.name for row in snapshot.hosts])
    check_name("array", array, {row.array for row in snapshot.processes if row.array})
    shown = [row for row in snapshot.processes if not host or row.host == host]
    if array:
        shown = [row for row in shown if row.array == array]
    if application:
        check_name("application", application, [row.name for row in snapshot.applications])
        shown = [row for row in shown if row.application == application]
    if as_json:
        forms = json_forms.forms(shown)
        json_forms.show(arrays.form(array, shown, forms) if array else forms)
        return
    if array:
        echo(arrays.summary(shown))
    listed = [row for row in shown if everything or row.state not in ("finished", "cancelled")]
    if listed:
        tables.show(tables.processes(listed))
    if len(listed) < len(shown):
        echo(f"{len(shown) - len(listed)} finished or cancelled (--all shows them)")
    elif not listed:
        echo("no process")


def hosts(ctx: typer.Context, as_json: AsJson = False, domain: Domain = None) -> None:
    """List the hosts and their usage.

    Usage and limit are percent of the capacity; `?` marks a stale reading.
    """
    from rosrm.cli.output import json_forms, tables

    with connection.master(ctx, domain) as client:
        snapshot = client.list(hosts=True)
        to_leave = [] if as_json else _to_leave(client, snapshot.hosts)
    connection.print_trouble(snapshot)
    rows = snapshot.hosts
    if as_json:
        json_forms.show(json_forms.forms(rows))
    elif rows:
        tables.show(tables.hosts(rows))
        for sentence in to_leave:
            echo(f"\n{sentence}")
    else:
        echo("no host; start `rosrm slave` on each")


def plugins(
    ctx: typer.Context,
    local: Annotated[
        bool,
        typer.Option(
            "--local", help="List the plugins installed on this machine; needs no master."
        ),
    ] = False,
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """List the plugins and their states.

    A plugin is selected, available, absent on a host, broken, or failing, and the reason is shown.
    """
    from rosrm.cli.installed_commands import ignored_commands
    from rosrm.cli.output import json_forms, tables
    from rosrm.extensions.registry import Registry

    if local:
        own = ctx.find_root().command
        rows = [*Registry.discover().rows(), *ignored_commands(getattr(own, "commands", ()))]
    else:
        with connection.master(ctx, domain) as client:
            rows = list(client.list_plugins())
    if as_json:
        json_forms.show(json_forms.forms(rows))
    elif rows:
        tables.show(tables.plugins(rows))
    else:
        echo("no plugin is installed; rosrm's own are in rosrm-scoring and its siblings")


def explain(ctx: typer.Context, name: Name, as_json: AsJson = False, domain: Domain = None) -> None:
    """Explain the placement of a process, or why it waits; or why a host must be left.

    Of a process: lists each host with its score, its veto or the requirement that it does not meet,
    then the newest events. Of a host over a limit or being drained: tells which processes leave it,
    and why others do not.
    """
    from rosrm.cli.output import explain, json_forms, tables

    with connection.master(ctx, domain) as client:
        explanation = _explanation(client, name)
    if as_json:
        json_forms.show(dict(explanation))
    elif "of_host" in explanation:
        echo("\n".join(explanation["reasons"]) or f"no process has to leave {name}")
    else:
        tables.show(explain.render(explanation))


def _explanation(client: Client, name: str) -> Mapping[str, Any]:
    """Return the explanation of a process, or of a host if no process has the name."""
    try:
        return client.explain(name)
    except Refused as refusal:
        if refusal.code == "unknown" and name in {h.description.name for h in client.list_hosts()}:
            return client.explain_host(name)
        raise


def _to_leave(client: Client, hosts: Iterable[HostRow]) -> list[str]:
    """Return sentences on the hosts that processes have to leave, of at most `_MOST_EXPLAINED`."""
    concerned = [row.description.name for row in hosts if row.must_be_left]
    found = [client.explain_host(name)["reasons"] for name in concerned[:_MOST_EXPLAINED]]
    others = ", ".join(few(concerned[_MOST_EXPLAINED:]))
    return [*chain(*found), *([f"`rosrm explain HOST` explains {others}"] if others else [])]


COMMANDS: Final = (status, ps, hosts, plugins, explain)
