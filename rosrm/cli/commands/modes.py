"""Command `rosrm mode`: lists and loads modes, and switches between them."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import connection
from rosrm.cli.commands.applications import AsPlanned, NoWait, Plan, begin, print_elsewhere
from rosrm.cli.commands.change import Timeout
from rosrm.cli.options import AsJson, Domain
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from rosrm.cli.planned import Request
    from rosrm.client.client import Client


def mode(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    name: Annotated[
        str, typer.Argument(metavar="MODE", help="Mode to switch to; default: list the modes.")
    ] = "",
    load: Annotated[
        Path | None,
        typer.Option(
            "--load", metavar="FILE", help="Replace the modes by those of FILE, a modes.yaml."
        ),
    ] = None,
    plan: Plan = False,
    as_planned: AsPlanned = "",
    no_wait: NoWait = False,
    timeout: Timeout = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """List the modes, load them from a file, or switch to one.

    A switch makes the applications of the mode as its file describes them, cancels those that only
    the mode in force has, and touches nothing else. It waits for the result, and exits with 1 if
    the mode is not in force then.
    """
    from rosrm.cli import planned

    if (plan or as_planned) and not name:
        option = "--plan" if plan else "--as-planned"
        raise ConfigError(f"{option}: give the mode, too: `rosrm mode NAME {option}`")
    kept = planned.read_plan(as_planned)
    with connection.master(ctx, domain) as client:
        if load is not None:
            echo(client.load_modes(load), err=as_json)
        if name:
            request = planned.as_planned(kept, partial(client.switch_mode, name))
            _switch(client, name, request, timeout, plan=plan, no_wait=no_wait, as_json=as_json)
        elif load is None:
            _show(client, as_json=as_json)


def _show(client: Client, *, as_json: bool) -> None:
    from rosrm.cli.output import json_forms, modes, tables

    snapshot = client.list(modes=True)
    connection.print_trouble(snapshot)
    if as_json:
        json_forms.show(json_forms.forms(snapshot.modes))
    elif snapshot.modes:
        tables.show(modes.modes(snapshot.modes))
    else:
        echo("no mode; `rosrm mode --load FILE` loads a modes.yaml")


def _switch(
    client: Client, name: str, request: Request, timeout: str, *,
    plan: bool, no_wait: bool, as_json: bool,
) -> None:  # fmt: skip
    """Request a mode; show its plan, or wait until it is in force."""
    from rosrm.cli.output import applications, modes
    from rosrm.cli.waiting import interruptible, longest

    limit = longest(timeout)
    result = begin(request, plan=plan, no_wait=no_wait, as_json=as_json)
    with interruptible("the switch continues (`rosrm mode`)"):
        rows = client.wait_for_mode(timeout=limit, on_change=applications.show_progress)
    print_elsewhere(client, result)
    if not modes.show_end(rows, name):
        raise typer.Exit(1)


COMMANDS: Final = (mode,)
