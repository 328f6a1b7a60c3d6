"""The environment of a process: the slave's own, without what the ROS wheels' bootstrapper did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.core.slave.reducer import qualified_name
from rosrm.model.values import Assignment
from rosrm.ros.fast_dds import announcements
from rosrm.ros.names import token
from rosrm.runtime.ros_wheels import without_bootstrapper

#: Set where an instance starts as the destination of a handoff.
SHADOW: Final = "ROSRM_SHADOW"
#: Where its node keeps its state for the next start, and how far behind it may be, seconds.
KEEP: Final = "ROSRM_KEEP"
KEEP_EVERY: Final = "ROSRM_KEEP_EVERY"
#: What tells a process who it is. A slave that was itself started by rosrm hands none of it on.
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
)


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """What a process is told of the cluster that it runs in.

    Attributes:
        host: name of the host in rosrm.
        cluster: name of the master that gives the orders.
        state_config: topic on which the master speaks of handoffs.
        kept: directory of the kept states of all processes; None: none are kept.
        keep_every: seconds by which a kept state may be behind.
    """

    host: str
    cluster: str
    state_config: str
    kept: Path | None = None
    keep_every: float = 1.0


def kept_directory(kept: Path, process: str) -> Path:
    """Where the state of one process is kept."""
    return kept / token(process)


def process_environment(
    assignment: Assignment,
    base: Mapping[str, str],
    where: Whereabouts,
    not_inherited: Sequence[str] = (),
) -> dict[str, str]:
    """All variables of an instance; what its spec says goes last.

    Args:
        assignment: whose instance it is for.
        base: the slave's own environment, its ROS settings (ROS_DOMAIN_ID, ...) included.
        where: it will run.
        not_inherited: variables that launchers set: those of the slave are its own.
    """
    spec = assignment.spec
    environment = without_bootstrapper(base)
    for name in (*_IDENTITY, *not_inherited):
        environment.pop(name, None)
    environment["ROSRM_PROCESS"] = assignment.instance.process
    environment["ROSRM_INSTANCE"] = str(assignment.instance)
    environment["ROSRM_HOST"] = where.host
    environment["ROSRM_STATE_CONFIG"] = where.state_config
    environment["ROSRM_MASTER"] = where.cluster
    environment["ROSRM_EPOCH"] = str(assignment.epoch)
    if spec.ros_node:  # under an alias too it is known by this name
        environment["ROSRM_NODE"] = qualified_name(spec.namespace, spec.name)
    if assignment.shadow:
        environment[SHADOW] = "1"
    if assignment.has_snapshots and where.kept is not None:
        environment[KEEP] = str(kept_directory(where.kept, spec.name))
        environment[KEEP_EVERY] = f"{where.keep_every:g}"
    environment["PYTHONUNBUFFERED"] = "1"
    environment.update(spec.environment)
    if assignment.shadow:  # a move waits until it has found everybody
        environment.update(announcements(environment, "steady", udp=False))
    return environment
