"""Workload as entries of a work file: services, ROS nodes with and without state, jobs.

The constants set the options for failures (host loss, isolation, standby, health).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
_PLAIN: Final = str(Path(__file__).with_name("plain.py"))

#: Numbers of services, chosen such that thirty processes live: these, a child of each tree,
#: standbys, and a guest. Jobs come on top.
PLAIN: Final = 12
TREES: Final = 2
SPEAKERS: Final = 4
COUNTERS: Final = 5
#: Counters with a standby on another host.
STANDBYS: Final = 2
#: Of each sort, the first so many go elsewhere when their host is lost; the others wait for it.
ELSEWHERE: Final = 2
#: Of each sort, the last so many are stopped by their host when it is cut off. They go elsewhere.
ISOLATED: Final = 1
#: Of the speakers and of the counters, the first so many have a health check: they must publish.
WATCHED: Final = 1

#: The application that gets new versions, and the seconds for which a new instance must run.
APPLICATION: Final = "rolling"
_HEALTHY: Final = 1.0

#: Cycles by which a replica on another host may be behind: snapshots are sent once a second.
COPIED: Final = 30

#: The host that takes the jobs of the line, one at a time: of its 2 GiB 80 % may be in use.
LINE_HOST: Final = "host5"
_LINE_NEED: Final = "900MiB"
#: Services go first: a process that waits for room blocks those behind it.
_FIRST: Final = 10


@dataclass(frozen=True)
class Sort:
    """A sort of services.

    Attributes:
        kind: of the program.
        ros: it is a ROS node.
        members: processes of one instance.
        strategy: of its migrations; "": it stays.
        stateful: its count continues in each successor.
        standby: it has a second instance, silent, on another host.
    """

    kind: str
    ros: bool = False
    members: int = 1
    strategy: str = ""
    stateful: bool = False
    standby: bool = False


@dataclass(frozen=True)
class Service:
    """A service that is to run all the time."""

    name: str
    sort: Sort
    elsewhere: bool = False
    isolated: bool = False
    watched: bool = False

    def entry(self, lines: Path) -> dict[str, Any]:
        """Return its entry of a work file."""
        entry = {
            **_common(self.name, lines),
            "priority": _FIRST,
            "restart": {"when": "on-failure", "delay": 0.2, "max_delay": 1.0, "attempts": 100_000},
        }
        if self.sort.ros:
            entry |= {"module": "benchmarks.chaos.nodes", "arguments": [self.sort.kind]}
            entry |= {"ros": True, "needs": {"memory": "64MiB"}}
            entry["environment"]["PYTHONPATH"] = str(ROOT)
        else:
            entry["command"] = [sys.executable, "-S", _PLAIN, self.sort.kind]
        if self.sort.strategy:
            entry["migration"] = {"strategy": self.sort.strategy}
        if self.elsewhere or self.isolated:
            entry["host_loss"] = {"then": "elsewhere"}
        if self.isolated:
            entry["isolation"] = {"then": "stop"}
        if self.watched:
            entry["health"] = {"topic": "~/count", "rate": 3.0, "timeout": 3.0}
        if self.sort.standby:
            entry["standby"] = {"wanted": True}
        return entry


_SORTS: Final = {
    "plain": (Sort("service"), PLAIN),
    "tree": (Sort("tree", members=2), TREES),
    "speaker": (Sort("speaker", ros=True, strategy="relaunch"), SPEAKERS),
    "counter": (Sort("counter", ros=True, strategy="handoff", stateful=True), COUNTERS),
    "guarded": (
        Sort("counter", ros=True, strategy="handoff", stateful=True, standby=True), STANDBYS,
    ),
}  # fmt: skip


def services() -> Iterator[Service]:
    """Yield the services that run from the beginning to the end."""
    for word, (sort, count) in _SORTS.items():
        for number in range(1, count + 1):
            isolated = number > count - ISOLATED
            watched = sort.ros and number <= WATCHED
            elsewhere = number <= ELSEWHERE or isolated
            yield Service(f"{word}{number}", sort, elsewhere, isolated, watched)


def guest(number: int) -> Service:
    """Return a guest: a service that is cancelled when the next guest is submitted."""
    sort = (_SORTS["plain"], _SORTS["counter"], _SORTS["tree"])[number % 3][0]
    return Service(f"guest{number}", sort, elsewhere=bool(number % 2))


def rolled() -> Iterator[Service]:
    """Yield the processes of the application that gets new versions, one for each strategy."""
    for word in ("plain", "speaker", "counter"):
        yield Service(f"{APPLICATION}_{word}", _SORTS[word][0])


def version(number: int, lines: Path, faulty: str = "") -> dict[str, Any]:
    """Return the work file of a version of the application.

    Args:
        faulty: name of the process that ends at its start; "": none.
    """
    entries = [one.entry(lines) for one in rolled()]
    for entry in entries:
        entry["environment"]["CHAOS_VERSION"] = str(number)
        if entry["name"] == faulty:
            entry["environment"]["CHAOS_FAULTY"] = "yes"
    return {"app": APPLICATION, "rollout": {"healthy_for": _HEALTHY}, "processes": entries}


def job(name: str, lines: Path, seconds: float, *, host: str = "") -> dict[str, Any]:
    """Return the entry of a job; with a host, it runs there alone."""
    entry = {
        **_common(name, lines),
        "kind": "job",
        "command": [sys.executable, "-S", _PLAIN, "job", f"{seconds:g}"],
        "restart": {"when": "on-failure", "delay": 0.2, "max_delay": 1.0, "attempts": 100_000},
    }
    if host:
        entry["labels"] = {"required": {"name": host}}
    return entry


def line_job(name: str, lines: Path, seconds: float) -> dict[str, Any]:
    """Return the entry of a job that waits in line: there is room for one at a time."""
    entry = job(name, lines, seconds, host=LINE_HOST)
    return {**entry, "needs": {"memory": _LINE_NEED}}


def _common(name: str, lines: Path) -> dict[str, Any]:
    return {
        "name": name,
        "environment": {"CHAOS_LINES": str(lines)},
        "needs": {"memory": "8MiB"},
        "stop": {"interrupt_grace": 2.0, "terminate_grace": 2.0},
    }
