"""Status of the hosts of a lab."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rosrm_lab import disks, groups
from rosrm_lab.groups import Hierarchy
from rosrm_lab.host import DATA
from rosrm_lab.plan import HostPlan
from rosrm_lab.store import LabRecord


@dataclass(frozen=True, slots=True)
class HostStatus:
    """The status of a host.

    Attributes:
        lab: the name of its lab.
        name: of the host.
        state: "up" or "off".
        address: on the lab's network.
        memory: bytes its limited processes may use; None: no limit.
        memory_used: bytes; None: not known.
        cpu: cores its limited processes may use; None: no limit.
        disk: bytes of its disk.
        disk_used: bytes; None: not known, because the host is off.
        processes: how many run there.
        network: the faults of its link, as text; "": none.
    """

    lab: str
    name: str
    state: str
    address: str
    memory: int | None
    memory_used: int | None
    cpu: float | None
    disk: int
    disk_used: int | None
    processes: int
    network: str


def host_status(hierarchies: Sequence[Hierarchy], record: LabRecord, host: HostPlan) -> HostStatus:
    """Return the present status of a host."""
    lab, alive = record.plan.name, record.is_up(host.name)
    return HostStatus(
        lab=lab,
        name=host.name,
        state="up" if alive else "off",
        address=str(record.plan.address(host.name)),
        memory=host.memory,
        memory_used=groups.memory_used(hierarchies, lab, host.name),
        cpu=host.cpu,
        disk=host.disk,
        disk_used=disks.used(record.outside(host.name, DATA)) if alive else None,
        processes=len(groups.processes(hierarchies, lab, host.name)),
        network=record.links[host.name].describe(),
    )
