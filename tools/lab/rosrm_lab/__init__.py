"""Virtual hosts on one Linux machine: namespaces, control groups and disks of their own.

::

    from rosrm_lab import GIB, HostPlan, Lab, uniform

    with Lab("test", [*uniform(3, memory=GIB, cpu=0.5), HostPlan("desk")]) as lab:
        slave = lab.popen("host1", ["rosrm", "slave"])
        lab.cut("host2", "in")
        lab.kill("host3")

Needs root.
"""

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
