"""Commands that change processes or hosts, from `submit` to `prune`."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli import completion, connection
from rosrm.cli.options import Application, Array, Domain, Host, Name, Names
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError
from rosrm.wording import counted

if TYPE_CHECKING:
    from rosrm.client.client import Client

Wait = Annotated[
    bool, typer.Option("--wait", help="Wait for the result; exit 1 with the reason if it failed.")
]
Timeout = Annotated[
    str,
    typer.Option(
        "--timeout", metavar="TIME", help="With --wait: maximum wait, e.g. 5min; default: no limit."
    ),
]
#: Endings of file names: an argument with such an ending, or with a slash, is a file.
_FILE_ENDINGS: Final = (".yaml", ".yml")


def submit(
    ctx: typer.Context,
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="WORK...", help="work.yaml: the processes to run; - is the standard input."
        ),
    ],
    *,
    wait: Annotated[
        bool,
        typer.Option(
            "--wait",
            help="Wait until each job has ended and each service runs; exit 1 if one does not.",
        ),
    ] = False,
    trace: Annotated[
        bool,
        typer.Option(
            "--trace",
            help="Wait for the start of each process, and show its hand-overs: when each part "
            "received it and passed it on.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="With --trace: print JSON instead of tables.")
    ] = False,
    timeout: Timeout = "",
    domain: Domain = None,
) -> None:
    """Queue the processes of work files.

    If one process cannot be queued, none is.
    """
    from rosrm.cli.waiting import interruptible, longest, show_change, show_processes
    from rosrm.config.work import load_work

    if as_json and not trace:
        raise ConfigError("submit: --json is for the output of --trace; add --trace, or omit it")
    if as_json and wait:
        raise ConfigError("submit: --wait prints no JSON; omit --wait or --json")
    limit = longest(timeout)
    work = {file: load_work(file) for file in files}
    specs = [spec for file in files for spec in work[file]]
    for file, parts in work.items():
        connection.warn_of_files(parts, file)
    left = "the submitted processes stay queued or run (`rosrm ps`)"
    with connection.master(ctx, domain) as client:
        if trace:
            from rosrm.cli.output import start_traces

            with interruptible(left):
                start_traces.show(client.submit_traced(specs, timeout=limit), as_json=as_json)
        else:
            echo(client.submit(specs))
        if wait:
            with interruptible(left):
                names = [spec.name for spec in specs]
                show_processes(client.wait(names, timeout=limit, on_change=show_change))


def cancel(  # noqa: PLR0913 - an argument for each option
    ctx: typer.Context,
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME|WORK...",
            help="Processes, or work files that name them.",
            autocompletion=completion.processes,
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="All processes that have not ended.")
    ] = False,
    array: Array = "",
    application: Application = "",
    *,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Kill them at once (SIGKILL), without the graces of their `stop`, also those that "
            "are being stopped already. Only for operators.",
        ),
    ] = False,
    wait: Wait = False,
    timeout: Timeout = "",
    domain: Domain = None,
) -> None:
    """Cancel processes: remove them from the queue, or stop them for good.

    For a work file, all its processes that have not ended are cancelled. A cancelled application
    keeps its versions: `rosrm revert APP` makes one of them the desired one again.
    """
    from rosrm.cli.waiting import interruptible, longest, show_change, show_processes
    from rosrm.client.connecting import check_name
    from rosrm.client.waiting import ENDED

    limit, chosen = longest(timeout), words or []
    if [everything, bool(array), bool(application), bool(chosen)].count(True) != 1:
        raise ConfigError(
            "cancel: give names of processes or work files, --array NAME, --app NAME, or --all"
        )
    named = [word for word in chosen if not _is_file(word)]
    filed = {name for word in chosen if _is_file(word) for name in _names_in(word)}
    with connection.master(ctx, domain) as client:
        if application:
            echo(client.cancel_application(application).message)
        if everything or array or filed or application:
            rows = client.list_processes()
            check_name("array", array, {row.array for row in rows if row.array})
            live = [row for row in rows if row.state not in ENDED]
            named += [
                row.name for row in live
                if everything or row.name in filed or (array and row.array == array)
                or (application and row.application == application)
            ]  # fmt: skip
        names = list(dict.fromkeys(named))
        outcome = ""
        if not names and not application:
            echo("no process to cancel: all of them have ended, or were never submitted")
            return
        if not application or (force and names):
            outcome = client.cancel(names, force=force)
            echo(outcome)
        # If all processes were still queued, the master's reply reports their end already.
        if wait and names and outcome != f"{counted(len(names), 'process', 'processes')} cancelled":
            with interruptible("the processes are still being cancelled (`rosrm ps`)"):
                show_processes(
                    client.wait(names, until="ended", timeout=limit, on_change=show_change)
                )


def _is_file(word: str) -> bool:
    return word == "-" or "/" in word or word.endswith(_FILE_ENDINGS)


def _names_in(file: str) -> list[str]:
    from rosrm.config.work import load_work

    return [spec.name for spec in load_work(file, check_artifacts=False)]


def restart(
    ctx: typer.Context,
    names: Names,
    wait: Wait = False,
    timeout: Timeout = "",
    domain: Domain = None,
) -> None:
    """Restart processes.

    A running process is restarted on its host; one that has ended is queued again.
    """
    from rosrm.cli.waiting import interruptible, longest, show_change, show_processes

    limit = longest(timeout)
    with connection.master(ctx, domain) as client:
        rows = client.list_processes() if wait else ()
        echo(client.restart(names))
        if wait:
            with interruptible("the processes are still being restarted (`rosrm ps`)"):
                show_processes(
                    client.wait(names, timeout=limit, previous=rows, on_change=show_change)
                )


def migrate(
    ctx: typer.Context,
    name: Name,
    to: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="HOST",
            help="Destination; default: the master chooses.",
            autocompletion=completion.hosts,
        ),
    ] = None,
    wait: Wait = False,
    timeout: Timeout = "",
    domain: Domain = None,
) -> None:
    """Move a process to another host.

    The migration strategy that its work file names moves it.
    """
    _with_ending(ctx, name, lambda client: client.migrate(name, to), domain, wait, timeout)


def checkpoint(
    ctx: typer.Context, name: Name, wait: Wait = False, timeout: Timeout = "", domain: Domain = None
) -> None:
    """Write the memory of a process to a checkpoint image, and stop it.

    `rosrm restore` continues the process from there.
    """
    _with_ending(ctx, name, lambda client: client.checkpoint(name), domain, wait, timeout)


def restore(
    ctx: typer.Context, name: Name, wait: Wait = False, timeout: Timeout = "", domain: Domain = None
) -> None:
    """Restore a process from its checkpoint image, on the image's host."""
    _with_ending(ctx, name, lambda client: client.restore(name), domain, wait, timeout)


def _with_ending(
    ctx: typer.Context, name: str, ask: Callable[[Client], str], domain: int | None,
    wait: bool, timeout: str,
) -> None:  # fmt: skip
    """Send a request whose completion is an event; with `wait`, wait for the event."""
    from rosrm.cli.waiting import interruptible, longest, show_change, show_end

    limit = longest(timeout)
    with connection.master(ctx, domain) as client:
        since = client.list().last_sequence if wait else 0
        echo(ask(client))
        if wait:
            with interruptible(
                f"the request for {name} continues (`rosrm events --process {name}`)"
            ):
                show_end(
                    client.wait_for_migration(
                        name, after=since, timeout=limit, on_change=show_change
                    )
                )


def cordon(ctx: typer.Context, host: Host, domain: Domain = None) -> None:
    """Stop giving new work to a host; its processes stay."""
    with connection.master(ctx, domain) as client:
        echo(client.cordon(host))


def uncordon(ctx: typer.Context, host: Host, domain: Domain = None) -> None:
    """Give new work to a host again."""
    with connection.master(ctx, domain) as client:
        echo(client.uncordon(host))


def drain(
    ctx: typer.Context,
    host: Host,
    wait: Annotated[
        bool,
        typer.Option(
            "--wait", help="Wait until the host is drained; exit 1 if processes stay there."
        ),
    ] = False,
    timeout: Timeout = "",
    domain: Domain = None,
) -> None:
    """Cordon a host and move away the processes that can leave it.

    The reply lists the processes that leave and those that cannot. The host is `drained` when no
    process is left that can leave.
    """
    from rosrm.cli.waiting import interruptible, longest, show_end

    limit = longest(timeout)
    with connection.master(ctx, domain) as client:
        since = client.list().last_sequence if wait else 0
        echo(client.drain(host))
        if wait:
            with interruptible(f"{host} is still draining (`rosrm uncordon {host}` ends that)"):
                show_end(client.wait_for_drain(host, after=since, timeout=limit))


def prune(
    ctx: typer.Context,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...", help="Names of ended processes.", autocompletion=completion.processes
        ),
    ] = None,
    hosts: Annotated[
        list[str] | None,
        typer.Option(
            "--host",
            metavar="HOST",
            help="A host that left or is lost; repeatable.",
            autocompletion=completion.hosts,
        ),
    ] = None,
    domain: Domain = None,
) -> None:
    """Remove ended processes and departed hosts from all listings.

    Without names, remove all ended processes and all hosts that left. A lost host is removed only
    by `--host`; processes that were being cancelled there are cancelled then.
    """
    with connection.master(ctx, domain) as client:
        echo(client.prune(names or [], hosts or []))


def rebalance(
    ctx: typer.Context,
    plan: Annotated[bool, typer.Option("--plan", help="Show the moves, and begin none.")] = False,
    domain: Domain = None,
) -> None:
    """Move processes to even out the load of the hosts, once.

    The bounds are those of the section `rebalance` of cluster.yaml.
    """
    with connection.master(ctx, domain) as client:
        echo(client.rebalance(plan_only=plan))


def reload(ctx: typer.Context, domain: Domain = None) -> None:
    """Let the master and all slaves read their files again, without a restart.

    Each file is checked as a whole first: an invalid one changes nothing. Settings that need a
    restart are named, and stay as before.
    """
    with connection.master(ctx, domain) as client:
        echo(client.reload())


COMMANDS: Final = (
    submit, cancel, restart, migrate, checkpoint, restore, cordon, uncordon, drain, prune,
    rebalance, reload,
)  # fmt: skip
