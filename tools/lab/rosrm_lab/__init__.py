"""Virtual hosts on one Linux machine: namespaces, control groups and disks of their own.

::

    from rosrm_lab import GIB, HostPlan, Lab, uniform

    with Lab("test", [*uniform(3, memory=GIB, cpu=0.5), HostPlan("desk")]) as lab:
        slave = lab.popen("host1", ["rosrm", "slave"])
        lab.cut("host2", "in")
        lab.kill("host3")

Needs root.

A name is imported when it is first asked for: `rosrm --help` imports this package for the command.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rosrm_lab.host import DATA
    from rosrm_lab.lab import Lab, all_labs
    from rosrm_lab.plan import GIB, MIB, HostPlan, LabPlan, uniform
    from rosrm_lab.status import HostStatus
    from rosrm_lab.wires import Direction

__all__ = [
    "DATA",
    "GIB",
    "MIB",
    "Direction",
    "HostPlan",
    "HostStatus",
    "Lab",
    "LabPlan",
    "all_labs",
    "uniform",
]

_HOMES: Final = {
    "DATA": "host",
    "Direction": "wires",
    "GIB": "plan",
    "HostPlan": "plan",
    "HostStatus": "status",
    "Lab": "lab",
    "LabPlan": "plan",
    "MIB": "plan",
    "all_labs": "lab",
    "uniform": "plan",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
