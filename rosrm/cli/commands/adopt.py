"""Command `rosrm adopt`: a process that runs already becomes a process of rosrm."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from rosrm.cli import completion, connection
from rosrm.cli.options import Domain
from rosrm.cli.output.plain import echo

if TYPE_CHECKING:
    from rosrm.cli.adoption.entry import Entry


def adopt(
    ctx: typer.Context,
    pid: Annotated[
        int, typer.Argument(metavar="PID", help="Process id on this machine, e.g. 4711.")
    ],
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Name in rosrm, e.g. talker.")
    ],
    host: Annotated[
        str,
        typer.Option(
            "--host", metavar="HOST",
            help="Host on this machine; default: the only one that runs here.",
            autocompletion=completion.hosts,
        ),
    ] = "",
    *,
    plan: Annotated[
        bool, typer.Option("--plan", help="Print the entry of a work file, and change nothing.")
    ] = False,
    timeout: Annotated[
        str,
        typer.Option(
            "--timeout", metavar="TIME", help="Maximum wait for the adoption, e.g. 5min."
        ),
    ] = "60s",
    domain: Domain = None,
) -> None:  # fmt: skip
    """Watch, stop and restart a process that was started without rosrm.

    The process runs on. Its restarts and moves start the program by the printed entry, which is
    taken from its command line and environment.
    """
    from dataclasses import replace

    from rosrm.cli.adoption.entry import entry_of, has_relaunch
    from rosrm.cli.adoption.facts import read_facts
    from rosrm.cli.adoption.local_host import environment_on, local_host
    from rosrm.cli.waiting import answered, interruptible, longest, show_change, show_processes
    from rosrm.config.work import processes_of
    from rosrm.model.adoption import Adoption
    from rosrm.supervisor.procfs import boot_id

    limit = longest(timeout)
    facts = answered(lambda: read_facts(pid), f"the inspection of process {pid}")
    with connection.master(ctx, domain) as client:
        row = local_host(client.list_hosts(), host)
        settings = connection.ros_settings(ctx, domain)
        moves = has_relaunch(client.list_plugins())
        entry = answered(
            lambda: entry_of(facts, name, environment_on(row, settings), moves=moves),
            f"the search for the program of process {pid}",
        )
        (spec,) = processes_of(entry.keys)
        where = row.description.name
        _show(entry, f"process {pid} of {where}")
        if plan:
            return
        adopted = Adoption(where, pid, facts.birth, boot_id())
        echo(client.submit(replace(spec, adoption=adopted)))
        with interruptible(f"{name} stays with rosrm (`rosrm ps`)"):
            show_processes(client.wait([name], timeout=limit, on_change=show_change))


def _show(entry: Entry, process: str) -> None:
    """Print the entry as a work file, with what is not taken."""
    import yaml

    from rosrm.wording import listed

    echo(f"# {process}: its restarts and moves start this")
    work = {"processes": [entry.keys]}
    for line in yaml.safe_dump(work, sort_keys=False, allow_unicode=True).splitlines():
        echo(line)
    if entry.directory:
        echo(f"# not taken: the working directory {entry.directory}")
    if entry.left:
        echo(f"# not taken: the variables {listed(entry.left, most=len(entry.left))}")


COMMANDS = (adopt,)
