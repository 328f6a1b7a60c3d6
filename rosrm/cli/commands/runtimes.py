"""Commands `rosrm master` and `rosrm slave`: check all settings, then execute the runtime.

The runtime replaces this process, imports neither pydantic nor typer nor rich, and reads the
checked settings from an inherited file.
"""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli.options import CommonOptions, Domain
from rosrm.cli.output.plain import echo
from rosrm.runtime.bootstrap import command_line, hand_over, interrupts_held
from rosrm.runtime.settings_check import SettingsSource

if TYPE_CHECKING:
    from rosrm.config.settings import ClusterConfig, HostConfig
    from rosrm.model.ros_settings import RosSettings


def master(
    ctx: typer.Context,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="FILE",
            help="A cluster.yaml; default: --cluster, else the default settings.",
        ),
    ] = None,
    recover: Annotated[
        bool,
        typer.Option("--recover", help="First rebuild a damaged journal from its readable part."),
    ] = False,
    domain: Domain = None,
) -> None:
    """Start the master of a cluster.

    The master runs until Ctrl-C. Processes keep running, and a restarted master takes them over.
    Without a terminal, SIGHUP reads its file again.
    """
    from rosrm.config.cluster import default_cluster, load_cluster
    from rosrm.extensions.registry import Registry
    from rosrm.runtime.state_lock import only_one

    registry = Registry.discover()
    file = config or ctx.ensure_object(CommonOptions).cluster
    settings = load_cluster(file, registry) if file else default_cluster(registry)
    settings = replace(settings, ros=with_domain(settings.ros, ctx, domain))
    if recover:
        echo(_recover(settings.state), err=True)
    with only_one(settings.state, "master", code="second_master", remedy="another `state:`"):
        echo(_master_summary(settings), err=True)
    become("rosrm.master", settings.to_json(), _source("master", file, ctx, domain))


def slave(
    ctx: typer.Context,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="FILE", help="A host.yaml; default: the default settings."
        ),
    ] = None,
    stop_everything: Annotated[
        bool,
        typer.Option(
            "--stop-all",
            help="Start no slave: stop the processes that an earlier slave left running.",
        ),
    ] = False,
    domain: Domain = None,
) -> None:
    """Start the slave of this host.

    The slave runs until Ctrl-C, SIGTERM or SIGHUP (a closed terminal), which stop its processes
    too, unless the file has `on_stop: keep`. Without a terminal, SIGHUP reads its file again.
    """
    from rosrm.config.first_name import keep_name
    from rosrm.config.host import load_host
    from rosrm.config.settings import HostConfig, place_of_name
    from rosrm.extensions.registry import Registry
    from rosrm.runtime.state_lock import only_one

    registry = Registry.discover()
    settings = load_host(config, registry) if config else HostConfig()
    settings = replace(settings, ros=with_domain(settings.ros, ctx, domain))
    if stop_everything:
        if not (settings.state / "supervisor").is_dir():
            echo(f"nothing to stop: no slave was started with the state directory {settings.state}")
            return
        with only_one(settings.state, "slave", code="name_taken", remedy=""):
            pass  # fails if a slave runs, which must stop its processes itself
        become("rosrm.slave.stop_all", settings.to_json(), _source("slave", config, ctx, domain))
        return
    if settings.probes is None:
        registry.default_probes()  # raises if there is none
    remedy = "another `host:` and `state:`"
    with only_one(settings.state, "slave", code="name_taken", remedy=remedy):
        notice = keep_name(place_of_name(settings), settings.host)
        if notice:
            echo(notice, err=True)
        echo(_slave_summary(settings), err=True)
    become("rosrm.slave", settings.to_json(), _source("slave", config, ctx, domain))


def container(
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ARGUMENTS",
            help="Arguments of the node, as in `ros2 run`: --ros-args -r __node:=NAME ...",
        ),
    ] = None,
) -> None:
    """Start a component container for nodes in Python.

    `ros2 component load` and launch files load into it; Ctrl-C ends it with all its components.
    """
    words = [sys.executable, "-m", "rosrm.node.container", *(arguments or [])]
    os.execv(sys.executable, words)  # noqa: S606 - no shell is wanted


def become(module: str, settings: str, source: SettingsSource) -> None:
    """Replace this process by a runtime."""
    descriptor = hand_over(settings, source)
    sys.stdout.flush()
    sys.stderr.flush()
    with interrupts_held():
        os.execv(sys.executable, command_line(module, descriptor))  # noqa: S606 - no shell is wanted


def _source(role: str, file: Path | None, ctx: typer.Context, domain: int | None) -> SettingsSource:
    path = "" if file is None else str(file.absolute())
    return SettingsSource(role, path, _chosen_domain(ctx, domain))


def _chosen_domain(ctx: typer.Context, domain: int | None) -> int | None:
    return ctx.ensure_object(CommonOptions).domain if domain is None else domain


def with_domain(settings: RosSettings, ctx: typer.Context, domain: int | None) -> RosSettings:
    """Return checked ROS settings, with the domain of the command line if it names one."""
    from rosrm.ros.network_interface import check_interface

    chosen = _chosen_domain(ctx, domain)
    settings = settings if chosen is None else replace(settings, domain=chosen)
    settings.check()
    if interface := settings.interface_in_force():
        check_interface(interface)
    return settings


def _recover(state: Path) -> str:
    from rosrm.journal.recovery import recover
    from rosrm.runtime.state_lock import only_one

    with only_one(state, "master", code="second_master", remedy="another `state:`"):
        return recover(state / "journal.sqlite")


def _master_summary(settings: ClusterConfig) -> str:
    return (
        f"master {settings.name!r}: {settings.ros.describe()}; scoring {settings.chain}; "
        f"migration {', '.join(settings.migration.strategies) or 'none'}; state in {settings.state}"
    )


def _slave_summary(settings: HostConfig) -> str:
    limits = ", ".join(f"{name} {limit:.0%}" for name, limit in settings.limits.items())
    return (
        f"slave of {settings.host!r}: {settings.ros.describe()}; scope {settings.scope}; "
        f"limits {limits}; state in {settings.state}"
    )


COMMANDS: Final = (master, slave)
