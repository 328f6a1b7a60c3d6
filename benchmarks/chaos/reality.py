"""Live processes of the workload on a lab's hosts, by /proc. Imports nothing from rosrm."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")


@dataclass(frozen=True)
class Member:
    """A live process of the workload.

    Attributes:
        pid: on this machine.
        process: the name under which it was submitted.
        instance: which instance of the process.
        host: of the lab.
        state: a letter of /proc: "T" is stopped.
    """

    pid: int
    process: str
    instance: str
    host: str
    state: str


def members(lab: str) -> list[Member]:
    """Return every live process of the workload on the hosts of a lab."""
    return [one for pid in _pids() if (one := _member(pid, lab)) is not None]


def _pids() -> Iterator[int]:
    return (int(path.name) for path in _PROC.iterdir() if path.name.isdigit())


def _member(pid: int, lab: str) -> Member | None:
    """Return None where the process has ended, is not in the lab, or not of the workload."""
    folder = _PROC / str(pid)
    try:
        host = _host(folder, lab)
        if not host:
            return None
        variables = dict(
            variable.split("=", 1)
            for variable in (folder / "environ").read_bytes().decode(errors="replace").split("\0")
            if "=" in variable
        )
        state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return None
    # The variables suffice: no process of the workload starts a supervisor or a slave.
    if "CHAOS_LINES" not in variables or "ROSRM_INSTANCE" not in variables or state in "ZX":
        return None
    return Member(pid, variables["ROSRM_PROCESS"], variables["ROSRM_INSTANCE"], host, state)


def _host(folder: Path, lab: str) -> str:
    """Return the host by the process's control group; "": it is not of the lab."""
    found = re.search(rf"/rosrm-lab/{re.escape(lab)}/([^/\n]+)/", (folder / "cgroup").read_text())
    return found[1] if found else ""
