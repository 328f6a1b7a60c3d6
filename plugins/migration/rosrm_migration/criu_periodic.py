"""How `criu` dumps a portable node that goes on, for its start after a crash.

Its part in the ROS graph is made anew after each, so an image may be used while the process that it
is of has been heard since: its peers take what it says for a new node's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rosrm.model.plan import Execute
from rosrm_migration.criu_building import LONGER

if TYPE_CHECKING:
    from rosrm.model.values import InstanceId, ProcessSpec
    from rosrm_migration.criu import CriuOptions

#: The executors; `criu_periodic_steps` has what they do.
DUMP: Final = "criu_dump"
SWEEP: Final = "criu_sweep"


def periodic_step(
    spec: ProcessSpec, instance: InstanceId, host: str, now: int, options: CriuOptions
) -> Execute:
    """One checkpoint of an instance.

    Args:
        spec: of its process.
        instance: of a portable node.
        host: where it runs.
        now: unix time, whole seconds: each asking is another absence of the node.
        options: that hold for it.
    """
    seconds = {
        "leave": options.leave_timeout, "dump": options.dump_timeout, "join": options.join_timeout,
    }  # fmt: skip
    timeout = options.start_timeout + sum(seconds.values())
    arguments = {
        "process": spec.name, "source": instance.number, "destination": instance.number,
        "attempt": f"{instance}-periodic-{now}", "timeout": timeout, "seconds": seconds,
    }  # fmt: skip
    return Execute(DUMP, host, arguments, timeout + LONGER)
