"""Commands on applications: apply, apps, history, revert."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import completion, connection
from rosrm.cli.commands.change import Timeout
from rosrm.cli.options import AsJson, Domain
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from rosrm.cli.planned import Request
    from rosrm.client.client import Client
    from rosrm.model.applications import ApplyResult

Application = Annotated[
    str,
    typer.Argument(
        metavar="APP", help="Name of an application.", autocompletion=completion.applications
    ),
]
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
    from rosrm.cli import planned
    from rosrm.config.work import load_application

    targets = [load_application(file) for file in files]
    for file, target in zip(files, targets, strict=True):
        connection.warn_of_files(target.specs, file)
    kept = planned.read_plan(as_planned)

    def prepare(client: Client) -> Request:
        return planned.as_planned(kept, partial(client.apply_targets, targets))

    names = [target.application for target in targets]
    carry_out(ctx, names, prepare, domain, timeout, plan=plan, no_wait=no_wait, as_json=as_json)


def revert(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    application: Application,
    to: Annotated[
        int, typer.Option("--to", metavar="N", min=0, help="Version; default: the one before.")
    ] = 0,
    plan: Plan = False,
    as_planned: AsPlanned = "",
    no_wait: NoWait = False,
    timeout: Timeout = "",
    as_json: AsJson = False,
    domain: Domain = None,
) -> None:
    """Make an earlier version of an application the desired one again.

    `rosrm history APP` lists the versions.
    """
    from rosrm.cli import planned

    kept = planned.read_plan(as_planned)

    def prepare(client: Client) -> Request:
        version = to or _before(client, application)
        return planned.as_planned(kept, partial(client.revert, application, version))

    name = [application]
    carry_out(ctx, name, prepare, domain, timeout, plan=plan, no_wait=no_wait, as_json=as_json)


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
    ctx: typer.Context, names: list[str], prepare: Callable[[Client], Request],
    domain: int | None, timeout: str, *, plan: bool, no_wait: bool, as_json: bool,
) -> None:  # fmt: skip
    """Send a request on applications; show its plan, or wait for its end.

    Args:
        ctx: of the command.
        names: of the applications.
        prepare: returns the request, given the client with which to make it.
        domain: ROS domain; None: that of the environment.
        timeout: duration of the wait as text; "": no limit.
        plan: the request is only planned.
        no_wait: the command ends once the master has accepted the request.
        as_json: the answer is shown as JSON.
    """
    from rosrm.cli.output import applications
    from rosrm.cli.waiting import interruptible, longest

    limit = longest(timeout)
    with connection.master(ctx, domain) as client:
        result = begin(prepare(client), plan=plan, no_wait=no_wait, as_json=as_json)
        # The desired version of an application without an action is the requested one.
        desired = {row.name: row.version for row in client.list_applications()}
        versions = {**desired, **result.versions}
        with interruptible("the applications change further (`rosrm apps`)"):
            rows = client.wait_for_applications(
                names, timeout=limit, on_change=applications.show_progress
            )
        print_elsewhere(client, result)
    shown = [applications.show_end(row, versions.get(row.name, 0)) for row in rows]
    missing = set(names).difference(row.name for row in rows)
    for name in sorted(missing):
        echo(f"rosrm: {name} is no longer listed", err=True)
    if missing or not all(shown):
        raise typer.Exit(1)


def begin(request: Request, *, plan: bool, no_wait: bool, as_json: bool) -> ApplyResult:
    """Make a request, and show its result.

    Raises:
        typer.Exit: the result is a plan, or its end is not awaited.
    """
    from rosrm.cli.output import applications, json_forms, tables

    result = request(plan_only=plan)
    if as_json:
        json_forms.show(json_forms.forms([result])[0])
    else:
        echo(result.message)
        if plan and result.actions:
            tables.show(applications.actions(result.actions))
    if plan or no_wait:
        raise typer.Exit(DIFFERS if plan and result.actions else 0)
    return result


def print_elsewhere(client: Client, result: ApplyResult) -> None:
    """Print which processes are on other hosts than in a kept plan."""
    from rosrm.cli.planned import elsewhere

    if any(action.host for action in result.actions):  # they are those of a plan
        for text in elsewhere(result.actions, client.list_processes()):
            echo(f"rosrm: other than planned: {text}", err=True)


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
