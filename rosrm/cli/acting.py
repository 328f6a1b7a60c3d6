"""Commands that change something, from `submit` to `drain`."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from rosrm.cli import connection
from rosrm.cli.options import Domain, Host, Name, Names

Wait = Annotated[
    bool, typer.Option("--wait", help="Wait until it is done; exit 1 if it failed, and say why.")
]


def submit(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="WORK", help="work.yaml: the processes to run.")],
    wait: Annotated[
        bool,
        typer.Option(
            "--wait",
            help="Wait until each job has ended and each service runs; exit 1 if one failed.",
        ),
    ] = False,
    timeout: Annotated[
        str,
        typer.Option(
            "--timeout", metavar="TIME", help="With --wait: the longest to wait, such as 5min."
        ),
    ] = "",
    domain: Domain = None,
) -> None:
    """Queue the processes of a work file.

    All of them are taken, or none.
    """
    from rosrm.cli.waiting import longest, wait_for
    from rosrm.config import load_work

    limit = longest(timeout)
    specs = load_work(file)
    with connection.master(ctx, domain) as client:
        typer.echo(client.submit(specs))
        if wait and not wait_for(client, [spec.name for spec in specs], limit):
            raise typer.Exit(1)


def cancel(ctx: typer.Context, names: Names, domain: Domain = None) -> None:
    """Cancel processes: take them out of the queue, or stop them for good."""
    with connection.master(ctx, domain) as client:
        typer.echo(client.cancel(names))


def restart(ctx: typer.Context, names: Names, domain: Domain = None) -> None:
    """Restart processes.

    A running process is restarted on its host; one that has ended is queued again.
    """
    with connection.master(ctx, domain) as client:
        typer.echo(client.restart(names))


def migrate(
    ctx: typer.Context,
    name: Name,
    to: Annotated[
        str | None,
        typer.Option("--to", metavar="HOST", help="Destination; default: the master chooses."),
    ] = None,
    domain: Domain = None,
) -> None:
    """Move a process to another host.

    The migration strategy that its work file names moves it.
    """
    with connection.master(ctx, domain) as client:
        typer.echo(client.migrate(name, to))


def checkpoint(ctx: typer.Context, name: Name, wait: Wait = False, domain: Domain = None) -> None:
    """Stop a process, with its memory in an image on its host.

    `rosrm restore` continues the process from there.
    """
    _through_image(ctx, name, "checkpoint", domain, wait=wait)


def restore(ctx: typer.Context, name: Name, wait: Wait = False, domain: Domain = None) -> None:
    """Restore a process from its image, on the host of the image."""
    _through_image(ctx, name, "restore", domain, wait=wait)


def _through_image(
    ctx: typer.Context, name: str, action: str, domain: int | None, *, wait: bool
) -> None:
    from rosrm.cli.waiting import wait_for_image

    with connection.master(ctx, domain) as client:
        since = client.list().last_sequence if wait else 0
        typer.echo(getattr(client, action)(name))
        if wait and not wait_for_image(client, name, since):
            raise typer.Exit(1)


def cordon(ctx: typer.Context, host: Host, domain: Domain = None) -> None:
    """Give a host no new work."""
    _set_host(ctx, host, "cordon", domain)


def uncordon(ctx: typer.Context, host: Host, domain: Domain = None) -> None:
    """Give a host work again."""
    _set_host(ctx, host, "uncordon", domain)


def drain(ctx: typer.Context, host: Host, domain: Domain = None) -> None:
    """Cordon a host and move away what can be."""
    _set_host(ctx, host, "drain", domain)


def _set_host(ctx: typer.Context, host: str, action: str, domain: int | None) -> None:
    with connection.master(ctx, domain) as client:
        typer.echo(client.set_host_state(host, action))


COMMANDS: Final = (submit, cancel, restart, migrate, checkpoint, restore, cordon, uncordon, drain)
