"""Virtual hosts on one Linux machine: namespaces, control groups and disks of their own.

::

    from rosrm.lab import GIB, HostPlan, Lab, uniform

    with Lab("test", [*uniform(3, memory=GIB, cpu=0.5), HostPlan("desk")]) as lab:
        slave = lab.popen("host1", ["rosrm", "slave"])
        lab.cut("host2", "in")
        lab.kill("host3")

Needs root, and the distribution's extra `lab` (pyroute2).
"""

from rosrm.lab.host import DATA
from rosrm.lab.lab import Lab, all_labs
from rosrm.lab.plan import GIB, MIB, HostPlan, LabPlan, uniform
from rosrm.lab.status import HostStatus
from rosrm.lab.wires import Direction

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
