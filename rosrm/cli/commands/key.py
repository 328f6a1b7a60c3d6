"""Commands `rosrm key`: the cluster's secret, and the keys of hosts and users."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError
from rosrm.wording import counted

if TYPE_CHECKING:
    from rosrm.keys.cluster import ClusterSecret
    from rosrm.keys.roles import Grant

key = typer.Typer(no_args_is_help=True, help="Manage the keys of hosts and users.")

_PRINCIPAL = typer.Argument(metavar="PRINCIPAL", help="host:NAME or user:NAME.")
_STANDARD_OUTPUT: Final = 1


@key.callback()
def _group() -> None:
    """Manage the keys of hosts and users. Run these on the master's machine; `check` on any."""


@key.command()
def init() -> None:
    """Create the cluster's secret, unless this user already has a secret.

    `rosrm master` does so, too. A program that can read the file has all rights in the cluster.
    """
    from rosrm.keys import key_files

    home = key_files.key_home()
    known = key_files.read_secret(home) is not None
    key_files.make_secret(home)
    echo(f"{home / key_files.CLUSTER_FILE}: {'exists already' if known else 'created'}")


@key.command()
def add(
    principal: Annotated[str, _PRINCIPAL],
    role: Annotated[
        str | None,
        typer.Option(
            "--role", metavar="ROLE",
            help="Role of a user: viewer (reads), submitter (changes its own processes) or "
            "operator (everything).  [default: role of the present key, else submitter]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE",
            help="Key file, for example robot-1.key, mode 0600; default: the standard output.",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Make a new key for a host or user, and write its key file.

    A running master refuses the former key of the host or user within a second. Copy the file to
    ~/.config/rosrm/ of the user that will use it. In a directory that others can read, use --out:
    with `> FILE` the shell creates the file before its mode is 0600.
    """
    from rosrm.keys import key_files
    from rosrm.keys.roles import GRANTED, Role, principal_of

    named = principal_of(principal)
    allowed = [one for one in GRANTED if (one is Role.HOST) is (named.kind == "host")]
    names = [one.value for one in allowed]
    secret, home = _secret(), key_files.key_home()
    present = [one.role for one in key_files.read_grants(home) if one.principal == named]
    usual = Role.HOST if named.kind == "host" else Role.SUBMITTER
    chosen = role or (present[0] if present else usual).value
    if chosen not in names:
        raise ConfigError(f"{named} cannot have the role {chosen!r}; allowed: {', '.join(names)}")
    if out is None:
        _make_output_private()

    def hand_out(grant: Grant) -> AbstractContextManager[Callable[[], None]]:
        made = secret.key_of(grant)
        if out is not None:
            return key_files.prepared_key(out, made)
        echo(key_files.text_of(made).rstrip())
        return nullcontext(lambda: None)

    key_files.add_grant(home, named, Role(chosen), hand_out)
    former = "; its former key is no longer valid" if present else ""
    echo(
        f"rosrm: {named} has a new key (role {chosen}){former}. Copy the file to ~/.config/rosrm/ "
        f"of the user that will use it, with mode 0600",
        err=True,
    )


def _make_output_private() -> None:
    """Set mode 0600 on the file of a redirected standard output, before a key is written."""
    facts = os.fstat(_STANDARD_OUTPUT)
    if stat.S_ISREG(facts.st_mode) and facts.st_uid == os.geteuid():
        os.fchmod(_STANDARD_OUTPUT, 0o600)


@key.command(name="list")
def list_keys() -> None:
    """List the principals that have a key, with their roles."""
    from rosrm.cli.output.tables import console, table
    from rosrm.keys import key_files

    _secret()
    home = key_files.key_home()
    rows = table("principal", "role", "key", right=["key"])
    grants = key_files.read_grants(home)
    for grant in grants:
        rows.add_row(str(grant.principal), grant.role.value, str(grant.generation))
    console().print(rows)
    echo(
        f"{counted(len(grants), 'key', 'keys')}; this user has all rights in the cluster, because "
        f"{home / key_files.CLUSTER_FILE} is readable"
    )


@key.command()
def revoke(principals: Annotated[list[str], _PRINCIPAL]) -> None:
    """Revoke the keys of hosts or users; a running master refuses them within a second."""
    from rosrm.keys import key_files
    from rosrm.keys.roles import principal_of

    chosen = [principal_of(text) for text in principals]
    _secret()
    key_files.revoke(key_files.key_home(), chosen)
    echo(f"revoked: {', '.join(map(str, chosen))}")


@key.command()
def rotate(
    directory: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIRECTORY",
            help="Directory for the new key files, for example new-keys; created if missing.",
        ),
    ],
) -> None:  # fmt: skip
    """Create a new secret for the cluster, and write new key files for all principals.

    A running master refuses all former keys within a second. Copy each file to its host or user,
    and restart all slaves.
    """
    from rosrm.keys import key_files

    _secret()
    written = key_files.rotate(key_files.key_home(), directory)
    files = counted(len(written), "key file", "key files")
    echo(f"created a new secret; wrote {files} to {directory}")


@key.command()
def check(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="A key file, for example robot-1.key; default: all keys of this user.",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            "--host", metavar="HOST",
            help="Name of the slave's host, for example robot-1; default: the machine's host name.",
        ),
    ] = "",
) -> None:  # fmt: skip
    """Show the keys of this user on this machine, and list what keys do not protect.

    Exits with 1 if this user has no key, others can read a key, or a key is not valid.
    """
    from rosrm.cli.output.keys import file_report, user_report
    from rosrm.keys.key_files import key_home

    report = user_report(key_home(), host) if file is None else file_report(key_home(), file)
    for label, text in report.rows:
        echo(f"{label:<15}{text}")
    for fault in report.faults:
        echo(f"{'problem':<15}{fault}")
    if report.faults:
        raise typer.Exit(1)


def _secret() -> ClusterSecret:
    from rosrm.keys import key_files

    home = key_files.key_home()
    secret = key_files.read_secret(home)
    if secret is None:
        raise ConfigError(
            f"there is no {home / key_files.CLUSTER_FILE}: run this command on the master's "
            f"machine as the master's user, or create the file with `rosrm key init`"
        )
    return secret
