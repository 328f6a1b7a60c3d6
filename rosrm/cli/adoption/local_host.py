"""The host of a cluster that runs on this machine."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping, Sequence

from rosrm.cli.adoption.environment import DOMAIN
from rosrm.cli.adoption.facts import environment_of
from rosrm.client.connecting import check_name
from rosrm.errors import ConfigError, Refused
from rosrm.model.ros_settings import RosSettings
from rosrm.model.rows import HostRow
from rosrm.supervisor import procfs
from rosrm.supervisor.adoption import is_own
from rosrm.wording import listed, reason_of


def local_host(hosts: Sequence[HostRow], wanted: str) -> HostRow:
    """Return the host that runs on this machine; `wanted`: its name, "": the only one.

    Raises:
        ConfigError: several hosts run here.
        Refused: no host runs here, or `wanted` is unknown or runs elsewhere.
    """
    here = {row.description.name: row for row in hosts if _is_here(row)}
    if wanted:
        check_name("host", wanted, [row.description.name for row in hosts])
    if wanted and wanted not in here:
        raise Refused(f"{wanted} does not run on this machine: type the command on {wanted}")
    if not here:
        raise Refused("no host of the cluster runs on this machine, which has the process")
    if not wanted and len(here) > 1:
        names = listed(sorted(here), "or")
        raise ConfigError(f"--host: several hosts run on this machine: {names}")
    return here[wanted or next(iter(here))]


def _is_here(row: HostRow) -> bool:
    own = row.description
    return own.hostname == socket.gethostname() and is_own(procfs.command_line(own.pid))


def environment_on(host: HostRow, settings: RosSettings) -> Mapping[str, str]:
    """Return the environment that a host of this machine gives to its processes.

    Args:
        host: runs on this machine.
        settings: by which this command has reached the cluster.

    Raises:
        Refused: its slave runs as another user.
    """
    pid = host.description.pid
    if procfs.user_ids(pid) != {os.geteuid()}:
        raise Refused(
            f"the slave of {host.description.name} runs as another user: a process is adopted by a "
            "slave of the same user only"
        )
    try:
        # The slave has the domain from its settings, which its environment does not show.
        domain = {DOMAIN: os.environ[DOMAIN]} if DOMAIN in os.environ else {}
        return {**environment_of(pid), **domain, **settings.environment()}
    except OSError as error:
        raise Refused(f"the slave of {host.description.name}: {reason_of(error)}") from None
