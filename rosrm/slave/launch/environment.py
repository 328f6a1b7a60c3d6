"""Environment of a process: the slave's, without the changes of the ROS wheels' bootstrapper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.core.slave.reducer import qualified_name
from rosrm.model.values import Assignment
from rosrm.portable import VARIABLE as PORTABLE
from rosrm.ros.fast_dds import announcements
from rosrm.ros.names import token
from rosrm.runtime.ros_wheels import without_bootstrapper

#: Variable that is set if an instance starts as the destination of a handoff.
SHADOW: Final = "ROSRM_SHADOW"
#: Variables with the directory of the node's snapshots, and the seconds by which they may lag.
KEEP: Final = "ROSRM_KEEP"
KEEP_EVERY: Final = "ROSRM_KEEP_EVERY"
#: Variables that identify a process. A slave that was itself started by rosrm passes none of them
#: on.
_IDENTITY: Final = (
    "ROSRM_PROCESS",
    "ROSRM_INSTANCE",
    "ROSRM_HOST",
    "ROSRM_NODE",
    "ROSRM_STATE_CONFIG",
    "ROSRM_MASTER",
    "ROSRM_EPOCH",
    SHADOW,
    KEEP,
    KEEP_EVERY,
    PORTABLE,
)


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """Host and cluster of a process, as passed in its environment.

    Attributes:
        host: name of the host in rosrm.
        cluster: name of the master.
        state_config: topic on which the master publishes handoffs.
        kept: directory of the snapshots of all processes; None: no snapshots.
        keep_every: seconds by which a snapshot may be behind the state.
        portable: directory of the control files by which portable nodes leave and join the graph;
            it has the same path on all hosts. None: no control files.
        slave: incarnation of the slave, a random number. It separates clusters of the same name
            that share that directory.
    """

    host: str
    cluster: str
    state_config: str
    kept: Path | None = None
    keep_every: float = 1.0
    portable: Path | None = None
    slave: int = 0


def kept_directory(kept: Path, process: str) -> Path:
    """Return the directory of the snapshots of one process."""
    return kept / token(process)


def process_environment(
    assignment: Assignment, base: Mapping[str, str], where: Whereabouts
) -> dict[str, str]:
    """Return all variables of an instance; those of its spec take precedence.

    Args:
        assignment: of the instance.
        base: environment of the slave, with its ROS settings (ROS_DOMAIN_ID, ...).
        where: host and cluster of the instance.
    """
    spec = assignment.spec
    environment = without_bootstrapper(base)
    for name in _IDENTITY:
        environment.pop(name, None)
    environment["ROSRM_PROCESS"] = assignment.instance.process
    environment["ROSRM_INSTANCE"] = str(assignment.instance)
    environment["ROSRM_HOST"] = where.host
    environment["ROSRM_STATE_CONFIG"] = where.state_config
    environment["ROSRM_MASTER"] = where.cluster
    environment["ROSRM_EPOCH"] = str(assignment.epoch)
    if spec.ros_node:  # the name without the alias
        environment["ROSRM_NODE"] = qualified_name(spec.namespace, spec.name)
    if assignment.shadow:
        environment[SHADOW] = "1"
    if spec.keeps_state and where.kept is not None:
        environment[KEEP] = str(kept_directory(where.kept, spec.name))
        environment[KEEP_EVERY] = f"{where.keep_every:g}"
    if spec.portable and where.portable is not None:
        own = token(f"{assignment.instance} {where.cluster} {where.slave:x}")
        environment[PORTABLE] = str(where.portable / own)
    environment["PYTHONUNBUFFERED"] = "1"
    environment.update(spec.environment)
    if assignment.shadow:  # a migration waits for the end of its discovery
        environment.update(announcements(environment, "steady", udp=False))
    return environment
