"""Environment of a process: the slave's, without the changes of the ROS wheels' bootstrapper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.artifacts.cache import set_directory
from rosrm.model import start_trace
from rosrm.model.arrays import INDEX_VARIABLE
from rosrm.model.artifacts import ARTIFACTS_VARIABLE
from rosrm.model.devices import DEVICE_VARIABLE, Device, device_environment, device_values
from rosrm.model.placeholders import extended
from rosrm.model.values import Assignment, InstanceId, qualified_name
from rosrm.ros.fast_dds import announcements
from rosrm.ros.names import token
from rosrm.runtime.ros_wheels import without_bootstrapper
from rosrm.supervisor.procfs import KEEP

#: Variable that is set if an instance starts as the destination of a handoff.
SHADOW: Final = "ROSRM_SHADOW"
#: Variable with the file in which the slave notes the newest epoch of the master.
EPOCH_FILE: Final = "ROSRM_EPOCH_FILE"
#: Variable with the seconds by which the node's snapshots may lag.
KEEP_EVERY: Final = "ROSRM_KEEP_EVERY"
#: Variable with the key of an instance, in base64, for a process in a container; and that with the
#: file that has the key, for all other processes.
INSTANCE_KEY: Final = "ROSRM_INSTANCE_KEY"
KEY_FILE: Final = "ROSRM_INSTANCE_KEY_FILE"
#: Variable with the name of the launcher that has prepared the start of an instance.
LAUNCHER: Final = "ROSRM_LAUNCHER"
#: Variables that identify a process. A slave that was itself started by rosrm passes none of them
#: on.
_IDENTITY: Final = (
    "ROSRM_PROCESS", "ROSRM_INSTANCE", "ROSRM_HOST", "ROSRM_NODE", "ROSRM_STATE_CONFIG",
    "ROSRM_MASTER", "ROSRM_EPOCH", EPOCH_FILE, SHADOW, KEEP, KEEP_EVERY, INSTANCE_KEY, KEY_FILE,
    LAUNCHER, INDEX_VARIABLE,
    ARTIFACTS_VARIABLE, start_trace.VARIABLE,
)  # fmt: skip


def no_key(_instance: InstanceId) -> None:
    """Return None: with `security: none` instances have no key."""


@dataclass(frozen=True, slots=True)
class ProcessLocation:
    """Host and cluster of a process, as passed in its environment.

    Attributes:
        host: name of the host in rosrm.
        cluster: name of the master.
        state_config: topic on which the master publishes handoffs.
        snapshots: directory of the snapshots of all processes; None: no snapshots.
        keep_every: seconds by which a snapshot may be behind the state.
        epoch_file: file with the newest epoch of the master; None: there is none.
        instance_key: returns the key of an instance; None: with `security: none`.
        devices: devices of the host.
        artifacts: directory of the artifacts of all processes; None: there are none.
    """

    host: str
    cluster: str
    state_config: str
    snapshots: Path | None = None
    keep_every: float = 1.0
    epoch_file: Path | None = None
    instance_key: Callable[[InstanceId], bytes | None] = no_key
    devices: tuple[Device, ...] = ()
    artifacts: Path | None = None


def snapshot_directory(snapshots: Path, process: str) -> Path:
    """Return the directory of the snapshots of one process."""
    return snapshots / token(process)


def process_environment(
    assignment: Assignment, base: Mapping[str, str], where: ProcessLocation,
    not_inherited: Sequence[str] = (), key_file: str = "",
) -> dict[str, str]:  # fmt: skip
    """Return all variables of an instance; those of its spec take precedence, except its devices.

    Args:
        base: environment of the slave, with its ROS settings (ROS_DOMAIN_ID, ...).
        not_inherited: variables that launchers set, so those of the slave do not count.
        key_file: file with the key of the instance, because a process shows its environment to
            others: in logs, in reports, to its children; "": the instance has no key.
    """
    spec = assignment.spec
    environment = without_bootstrapper(base)
    of_host = dict(environment)
    own = [name for name in environment if name.startswith(DEVICE_VARIABLE)]
    for name in (*_IDENTITY, *own, *not_inherited):
        environment.pop(name, None)
    environment["ROSRM_PROCESS"] = assignment.instance.process
    environment["ROSRM_INSTANCE"] = str(assignment.instance)
    environment["ROSRM_HOST"] = where.host
    environment["ROSRM_STATE_CONFIG"] = where.state_config
    environment["ROSRM_MASTER"] = where.cluster
    environment["ROSRM_EPOCH"] = str(assignment.epoch)
    if where.epoch_file is not None:
        environment[EPOCH_FILE] = str(where.epoch_file)
    if spec.ros and spec.node:  # the name without the alias
        environment["ROSRM_NODE"] = qualified_name(spec.namespace, spec.node)
    if spec.array.name:
        environment[INDEX_VARIABLE] = str(spec.array.index)
    if assignment.shadow:
        environment[SHADOW] = "1"
    if assignment.has_snapshots and where.snapshots is not None:
        environment[KEEP] = str(snapshot_directory(where.snapshots, spec.name))
        environment[KEEP_EVERY] = f"{where.keep_every:g}"
    # Of each process, because a migratable node without a key takes messages of strangers.
    if key_file:
        environment[KEY_FILE] = key_file
    environment["PYTHONUNBUFFERED"] = "1"
    environment.update((name, extended(text, of_host)) for name, text in spec.environment.items())
    if spec.artifacts and where.artifacts is not None:
        environment[ARTIFACTS_VARIABLE] = str(set_directory(where.artifacts, spec.artifacts))
    values = device_values(assignment.devices, where.devices)
    environment.update(device_environment(assignment.devices, values))
    if assignment.shadow:  # a migration waits for the end of its discovery
        environment.update(announcements(environment, "steady", udp=False))
    return environment
