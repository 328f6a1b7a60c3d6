"""Connection to the master. Only this module imports ROS, and only when it is needed."""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from rosrm.errors import Refused, ros_needed
from rosrm.model.ros_settings import RosSettings
from rosrm.wording import no_such

if TYPE_CHECKING:
    from rosrm.config.settings import ClusterConfig
    from rosrm.keys.roles import SecurityMode
    from rosrm.ros.master_connection import MasterClient
    from rosrm.ros.participant import Participant

Row = TypeVar("Row")

#: Environment variable with the path of a cluster.yaml, whose `ros` section holds the settings.
CLUSTER_VARIABLE: Final = "ROSRM_CLUSTER"


def ros_settings(
    domain: int | None = None, cluster: str | os.PathLike[str] | None = None
) -> RosSettings:
    """Return the settings with which to join ROS.

    Args:
        domain: replaces the domain of the file and ROS_DOMAIN_ID.
        cluster: a cluster.yaml, whose `ros` section is read; None: that of ROSRM_CLUSTER.
    """
    config = _cluster_file(cluster)
    settings = RosSettings() if config is None else config.ros
    return settings if domain is None else replace(settings, domain=domain)


def security_mode(cluster: str | os.PathLike[str] | None = None) -> SecurityMode:
    """Return the security of a client: of the file, else of ROSRM_SECURITY, else "keys".

    Args:
        cluster: a cluster.yaml; None: that of ROSRM_CLUSTER.

    Raises:
        ConfigError: the file is invalid, or the variable has a value that is not allowed.
    """
    from rosrm.keys.roles import default_security  # noqa: PLC0415 - only where ROS is used

    config = _cluster_file(cluster)
    return default_security() if config is None else config.security


def _cluster_file(cluster: str | os.PathLike[str] | None) -> ClusterConfig | None:
    """Return the settings in a cluster.yaml; None: neither an argument nor a variable names one."""
    path = cluster or os.environ.get(CLUSTER_VARIABLE)
    if not path:
        return None
    from rosrm.config.cluster import load_cluster  # noqa: PLC0415 - pydantic only where a file is read

    return load_cluster(os.fspath(path))


def connect(
    settings: RosSettings, *, timeout: float, security: SecurityMode | None = None,
    joined: Participant | None = None, begun: float | None = None,
) -> MasterClient:  # fmt: skip
    """Find the master.

    Args:
        settings: with which to join ROS.
        timeout: seconds for finding the master.
        security: of the client; None: that of the environment, as `security_mode` returns it.
        joined: a participant with these settings, which the connection then owns.
        begun: monotonic time since which the user waits, for the message; None: since now.

    Raises:
        ConfigError: a key file is invalid, or others can read it.
        NoMaster: none answered in time, or this user has no key.
        Refused: the master is of another version.
        RosrmError: ROS 2 cannot be imported.
    """
    name = f"{getpass.getuser()}@{socket.gethostname()}:{os.getpid()}"
    with ros_needed():
        from rosrm.ros.master_connection import MasterClient  # noqa: PLC0415 - the first of ROS

        return MasterClient.connect(
            settings, name=name, timeout=timeout, security=security or security_mode(),
            joined=joined, begun=begun,
        )  # fmt: skip


def row_of(kind: str, name: str, rows: Mapping[str, Row]) -> Row:
    """Return the row of a name; refuse a name that has none, and name the nearest.

    Args:
        kind: "process" or "host".
        name: from the user.
        rows: those of the master, by their names.
    """
    if name not in rows:
        raise Refused(no_such(kind, [name], rows), "unknown")
    return rows[name]


def check_name(kind: str, name: str, known: Iterable[str]) -> None:
    """Refuse a name that is not known, as `row_of` does; "" stands for no name."""
    if name:
        row_of(kind, name, dict.fromkeys(known))
