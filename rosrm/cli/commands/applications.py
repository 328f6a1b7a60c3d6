"""Commands on applications: apply, apps, history, revert."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import connection
from rosrm.cli.commands.change import Timeout
from rosrm.cli.options import AsJson, Domain
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.applications import ApplyResult, Target

Application = Annotated[str, typer.Argument(metavar="APP", help="Name of an application.")]
Plan = Annotated[
    bool,
    typer.Option(
        "--plan", help="Show the actions, and begin none; exit 2 if there are any, 0 if not."
    ),
]
AsPlanned = Annotated[
    str,
    typer.Option(
        "--as-planned",
        metavar="PLAN",
        help="Begin only if PLAN, the output of `--plan --json`, still holds; say what differs.",
    ),
]
NoWait = Annotated[bool, typer.Option("--no-wait", help="End once the master has accepted it.")]

#: Exit code of a plan with actions, as of `diff` in other tools.
DIFFERS: Final = 2


def apply(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    files: Annotated[
        list[str],
        typer.Argument(metavar="WORK...", help="work.yaml with `app: NAME`; - is standard input."),
    ],
    plan: Plan = False,
    as_planned: AsPlanned = "",
    no_wait: NoWait = False,
    timeout: Timeout = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Make applications as their work files describe them.

    Missing processes start, processes that are not in the file any more stop, changed ones are
    replaced, and all others are not touched. Without --plan: waits for the result, and exits with 1
    if an application is not as described then.
    """
    from rosrm.cli.planned import read_plan
    from rosrm.config.work import load_application

    targets = [load_application(file) for file in files]
    planned = read_plan(as_planned) if as_planned else None

    def ask(client: Client) -> ApplyResult:
        if planned is None:
            return client.apply_targets(targets, plan_only=plan)
        return _as_planned(client, targets, planned, plan_only=plan)

    names = [target.application for target in targets]
    carry_out(ctx, names, ask, domain, timeout, plan=plan, no_wait=no_wait, as_json=as_json)


def _as_planned(
    client: Client, targets: Sequence[Target], planned: ApplyResult, *, plan_only: bool
) -> ApplyResult:
    """Apply targets if a kept plan still holds, and print what differs by other readings.

    Return the actions with the hosts that are planned now.
    """
    from rosrm.cli.planned import differences

    now = client.apply_targets(targets, plan_only=True)
    for text in differences(planned, now):
        echo(f"rosrm: other readings than at the time of the plan: {text}", err=True)
    return now if plan_only else replace(client.apply_targets(targets), actions=now.actions)


def revert(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    application: Application,
    to: Annotated[
        int, typer.Option("--to", metavar="N", min=0, help="Version; default: the one before.")
    ] = 0,
    plan: Plan = False,
    no_wait: NoWait = False,
    timeout: Timeout = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Make an earlier version of an application the desired one again.

    `rosrm history APP` lists the versions.
    """

    def ask(client: Client) -> ApplyResult:
        return client.revert(application, to or _before(client, application), plan_only=plan)

    carry_out(ctx, [application], ask, domain, timeout, plan=plan, no_wait=no_wait, as_json=as_json)


def _before(client: Client, application: str) -> int:
    """Return the newest version before the desired one that was not given up."""
    row = client.get_application(application)
    wanted = row.version or row.versions[-1].number + 1
    found = [one.number for one in row.versions if one.number < wanted and not one.given_up]
    if not found:
        raise ConfigError(
            f"{application} has no version before {wanted} that was not given up. `rosrm history "
            f"{application}` lists the versions, and `--to N` applies any of them"
        )
    return found[-1]


def carry_out(
    ctx: typer.Context, names: list[str], ask: Callable[[Client], ApplyResult],
    domain: int | None, timeout: str, *, plan: bool, no_wait: bool, as_json: bool,
) -> None:  # fmt: skip
    """Send a request on applications; show its plan, or wait for its end."""
    from rosrm.cli.output import applications, json_forms, tables
    from rosrm.cli.planned import elsewhere
    from rosrm.cli.waiting import interruptible, longest

    limit = longest(timeout)
    with connection.master(ctx, domain) as client:
        result = ask(client)
        if as_json:
            json_forms.show(json_forms.forms([result])[0])
        else:
            echo(result.message)
            if plan and result.actions:
                tables.show(applications.actions(result.actions))
        if plan:
            raise typer.Exit(DIFFERS if result.actions else 0)
        if no_wait:
            return
        with interruptible("the applications change further (`rosrm apps`)"):
            rows = client.wait_for_applications(
                names, timeout=limit, on_change=applications.show_progress
            )
        if any(action.host for action in result.actions):  # they are those of a plan
            for text in elsewhere(result.actions, client.list_processes()):
                echo(f"rosrm: other than planned: {text}", err=True)
    shown = [applications.show_end(row) for row in rows]
    missing = set(names).difference(row.name for row in rows)
    for name in sorted(missing):
        echo(f"rosrm: {name} is no longer listed", err=True)
    if missing or not all(shown):
        raise typer.Exit(1)


def apps(ctx: typer.Context, as_json: AsJson = False, domain: Domain = None) -> None:
    """List the applications."""
    from rosrm.cli.output import applications, json_forms, tables

    with connection.master(ctx, domain) as client:
        snapshot = client.list(applications=True)
    connection.print_trouble(snapshot)
    if as_json:
        json_forms.show(json_forms.forms(snapshot.applications))
    elif snapshot.applications:
        tables.show(applications.applications(snapshot.applications))
    else:
        echo("no application; `rosrm apply FILE` makes one of a work file with `app: NAME`")


def history(
    ctx: typer.Context,
    application: Application,
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """List the kept versions of an application."""
    from rosrm.cli.output import applications, json_forms, tables

    with connection.master(ctx, domain) as client:
        row = client.get_application(application)
    if as_json:
        json_forms.show(json_forms.forms(row.versions))
    else:
        tables.show(applications.versions(row))


COMMANDS: Final = (apply, revert, apps, history)
