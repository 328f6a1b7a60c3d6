"""Which processes of the workload run on a lab's hosts, by /proc. Knows nothing of rosrm."""

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
        instance: which run of it.
        host: of the lab.
        state: a letter of /proc: "T" is stopped.
    """

    pid: int
    process: str
    instance: str
    host: str
    state: str


def members(lab: str) -> list[Member]:
    """Every live process of the workload on the hosts of a lab."""
    return [one for pid in _pids() if (one := _member(pid, lab)) is not None]


def _pids() -> Iterator[int]:
    return (int(path.name) for path in _PROC.iterdir() if path.name.isdigit())


def _member(pid: int, lab: str) -> Member | None:
    """None: it has ended, is on no host of the lab, or is no part of the workload."""
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
    # A supervisor or slave may have been started by a process of the workload: never here.
    if "CHAOS_LINES" not in variables or "ROSRM_INSTANCE" not in variables or state in "ZX":
        return None
    return Member(pid, variables["ROSRM_PROCESS"], variables["ROSRM_INSTANCE"], host, state)


def _host(folder: Path, lab: str) -> str:
    """By its control group; "" for what is not of the lab."""
    found = re.search(rf"/rosrm-lab/{re.escape(lab)}/([^/\n]+)/", (folder / "cgroup").read_text())
    return found[1] if found else ""
