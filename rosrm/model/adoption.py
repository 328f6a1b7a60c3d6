"""Adoption: a running process that was started without rosrm becomes a process of rosrm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: Largest id of a process.
LARGEST_PID: Final = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Adoption:
    """The running process that becomes the first instance of a spec.

    Attributes:
        host: name of the host on which it runs; "": no process is adopted.
        pid: its id there.
        birth: its start time in clock ticks since the boot, which tells a reused pid apart.
        boot: id of the boot of its machine.
    """

    host: str = ""
    pid: int = 0
    birth: int = 0
    boot: str = ""


NO_ADOPTION: Final = Adoption()
