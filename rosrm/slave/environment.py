"""The environment of a process: the slave's own, without what the ROS wheels' bootstrapper did.

The wheels' `.pth` file executes Python anew with their library folders in LD_LIBRARY_PATH and with
a guard variable. A child that inherits both, and runs from another virtual environment, would load
the libraries of this one; without them its own bootstrapper does the right thing.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from rosrm.core.model import Assignment
from rosrm.core.slave import qualified_name
from rosrm.ros.participant import announcements

#: Set where an instance starts as the destination of a handoff.
SHADOW: Final = "ROSRM_SHADOW"
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
)
_GUARD: Final = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_LIBRARIES: Final = "LD_LIBRARY_PATH"
#: PREFIX/lib/pythonX.Y/site-packages/ros_NAME.libs: a folder that the bootstrapper adds.
_WHEEL_FOLDER: Final = re.compile(
    r"(?P<prefix_lib>.*/lib)/python[0-9.]+/site-packages/ros_[^/]*\.libs"
)


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """What a process is told of the cluster that it runs in.

    Attributes:
        host: name of the host in rosrm.
        cluster: name of the master that gives the orders.
        state_config: topic on which the master speaks of handoffs.
    """

    host: str
    cluster: str
    state_config: str


def process_environment(
    assignment: Assignment, base: Mapping[str, str], where: Whereabouts
) -> dict[str, str]:
    """All variables of an instance; what its spec says goes last.

    Args:
        assignment: whose instance it is for.
        base: the slave's own environment, its ROS settings (ROS_DOMAIN_ID, ...) included.
        where: it will run.
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
    if spec.ros or spec.package is not None:  # under an alias too it is known by this name
        environment["ROSRM_NODE"] = qualified_name(spec.namespace, spec.name)
    if assignment.shadow:
        environment[SHADOW] = "1"
    environment["PYTHONUNBUFFERED"] = "1"
    environment.update(spec.environment)
    if assignment.shadow:  # a move waits until it has found everybody
        environment.update(announcements(environment, "steady"))
    return environment


def without_bootstrapper(
    environment: Mapping[str, str], prefix: str = sys.prefix
) -> dict[str, str]:
    """Undo what the ROS wheels' bootstrapper put there; without its guard nothing is touched.

    The bootstrapper keeps what LD_LIBRARY_PATH held before, though in no order: that stays.

    Args:
        environment: to be cleaned; it stays as it is.
        prefix: of this Python.
    """
    cleaned = dict(environment)
    if cleaned.pop(_GUARD, None) is None:
        return cleaned
    before = _without_wheel_folders(cleaned.pop(_LIBRARIES, "").split(":"), prefix)
    if before:
        cleaned[_LIBRARIES] = ":".join(before)
    return cleaned


def _without_wheel_folders(folders: list[str], prefix: str) -> list[str]:
    added = {"", f"{prefix}/lib"}
    for folder in folders:
        wheel = _WHEEL_FOLDER.fullmatch(folder)
        if wheel:
            added.update((folder, wheel["prefix_lib"]))
    return [folder for folder in folders if folder not in added]
