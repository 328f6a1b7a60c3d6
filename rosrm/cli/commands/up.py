"""Command `rosrm up`: a master and its hosts on this machine, in one terminal."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from rosrm.cli import connection
from rosrm.cli.commands.runtimes import with_domain
from rosrm.cli.options import CommonOptions, Domain
from rosrm.wording import reason_of

if TYPE_CHECKING:
    from rosrm.config.settings import ClusterConfig
    from rosrm.extensions.registry import Registry
    from rosrm.model.ros_settings import RosSettings

Discovery = Literal["localhost", "subnet"]
#: Most hosts: with `localhost`, the first 32 participants of a domain discover each other.
_MOST_HOSTS: Final = 16


def up(  # noqa: PLR0917 - an argument for each option
    ctx: typer.Context,
    files: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="WORK...", help="Work files to submit, or with `app` to apply, on these hosts."
        ),
    ] = None,
    hosts: Annotated[
        int,
        typer.Option(
            "--hosts", metavar="N", min=1, max=_MOST_HOSTS,
            help="Number of hosts, which share this machine.",
        ),
    ] = 1,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="FILE",
            help="A cluster.yaml; default: --cluster, else the default settings.",
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state", metavar="DIR",
            help="Directory for state and logs, which stays; default: a temporary one.",
        ),
    ] = None,
    budget: Annotated[
        list[str] | None,
        typer.Option(
            "--budget", metavar="RESOURCE=AMOUNT",
            help="Memory, CPU or disk of each host, e.g. memory=2GB or cpu=1.5; repeatable; "
            "default: its share of what is free.",
        ),
    ] = None,
    discovery: Annotated[
        Discovery | None,
        typer.Option(
            "--discovery",
            help="Where ROS traffic goes: this machine only, or the whole subnet; default: as the "
            "file or ROS_AUTOMATIC_DISCOVERY_RANGE says, else localhost.",
        ),
    ] = None,
    domain: Domain = None,
) -> None:  # fmt: skip
    """Start a master and hosts on this machine, and show what happens.

    Each host is a slice of this machine with a share of its memory, CPU and disk. Ctrl-C ends all
    of it: the processes, then the hosts and the master; a second Ctrl-C kills everything at once.
    """
    from rosrm.cli.up import session, slices
    from rosrm.cli.up.cluster import UpCluster, cleaned
    from rosrm.config.documents import read
    from rosrm.config.work import checked_work
    from rosrm.extensions.registry import Registry
    from rosrm.ros.network_interface import check_loopback

    check_loopback()
    registry = Registry.discover()
    amounts = slices.budget_of(budget or [])
    file = config or ctx.ensure_object(CommonOptions).cluster
    settings = _settings(file, registry)
    ros = with_domain(_local(settings.ros, discovery), ctx, domain)
    work = [checked_work(read(name), name, registry) for name in files or []]
    for name, target in zip(files or [], work, strict=True):
        connection.warn_of_files(target.specs, name)
    directory = (state or _temporary_directory()).absolute()
    with cleaned(directory, keep=state is not None):
        cluster = UpCluster(
            directory, replace(settings, ros=ros),
            slices.slices(hosts, amounts, registry, directory),
            files={"master": file.absolute()} if file else {},
            joining=ros, ends_with_starter=True,
        )  # fmt: skip
        session.serve(cluster, work)


def _temporary_directory() -> Path:
    from rosrm.errors import ConfigError

    try:
        return Path(tempfile.mkdtemp(prefix="rosrm-up-"))
    except OSError as error:
        text = f"no temporary directory for the state: {reason_of(error)}; give one by --state DIR"
        raise ConfigError(text) from None


def _settings(file: Path | None, registry: Registry) -> ClusterConfig:
    from rosrm.config.cluster import default_cluster, load_cluster

    return load_cluster(file, registry) if file else default_cluster(registry)


def _local(ros: RosSettings, discovery: Discovery | None) -> RosSettings:
    """Return ROS settings that keep the traffic on this machine, unless others are chosen."""
    if discovery is not None:
        return replace(ros, discovery_range=discovery)
    joined = {**os.environ, **ros.environment()}
    is_chosen = (
        joined.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
        or joined.get("ROS_DISCOVERY_SERVER")
        or ros.interface_in_force()
    )
    return ros if is_chosen else replace(ros, discovery_range="localhost")


COMMANDS: Final = (up,)
