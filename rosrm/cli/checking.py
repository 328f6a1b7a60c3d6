"""`rosrm config check`: is this file right, before it is used?"""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosrm.spelling import counted

if TYPE_CHECKING:
    from rosrm.registry import Registry

config = typer.Typer(no_args_is_help=True, help="Look at configuration files.")


class KindOfFile(str, Enum):
    """What a file configures."""

    CLUSTER = "cluster"
    HOST = "host"
    WORK = "work"


@config.callback()
def _group() -> None:
    """Look at configuration files."""


@config.command()
def check(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="cluster.yaml, host.yaml or work.yaml.")
    ],
    kind: Annotated[
        KindOfFile | None,
        typer.Option("--kind", help="What the files are; by default their keys tell."),
    ] = None,
) -> None:
    """Check files before they are used.

    Against all rules, and against the plugins that are installed here.
    """
    from rosrm.errors import ConfigError
    from rosrm.registry import Registry

    registry = Registry.discover()
    wrong = []
    for file in files:
        try:
            typer.echo(f"{file}: ok, {_checked(file, kind, registry)}")
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("\n".join(wrong))


def _checked(file: Path, kind: KindOfFile | None, registry: Registry) -> str:
    """A summary of a file; raises `ConfigError`."""
    from rosrm.config import load_cluster, load_host, load_work
    from rosrm.config.documents import read
    from rosrm.config.kinds import kind_of

    match kind.value if kind else kind_of(read(file)):
        case "cluster":
            cluster = load_cluster(file, registry)
            strategies = ", ".join(cluster.migration.strategies) or "none"
            return f"a cluster: scoring {cluster.scoring.policy}, migration {strategies}"
        case "host":
            host = load_host(file, registry)
            probes = ", ".join(registry.default_probes() if host.probes is None else host.probes)
            return f"a host: {host.host}, probes {probes or 'none'}"
        case _:
            specs = load_work(file, registry)
            jobs = sum(spec.kind.value == "job" for spec in specs)
            return f"work: {counted(jobs, 'job')} and {counted(len(specs) - jobs, 'service')}"
