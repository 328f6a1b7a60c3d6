"""Diagnostic statuses of the master, of all hosts, and of processes that are not well.

=====  =======================================  =============================================
level  host                                     process
=====  =======================================  =============================================
OK     reports; or its slave was stopped        any other state
WARN   suspect; detached; from 90 % of a limit  set aside; in back-off; from 90 % of its limit
       on; some readings are old                of memory on
ERROR  lost                                     failed; unreachable; stuck
STALE  silent since the master started; all     its host is silent
       readings are old
=====  =======================================  =============================================
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rosrm.core.master.listing import host_row, host_rows, process_row
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.diagnostics import Diagnostic, Level, Subject
from rosrm.model.rows import HostRow, ProcessRow
from rosrm.wording import counted, first_line, listed, percent, size, standing

#: Share of a limit from which on a host or process is near it.
_NEAR: Final = 0.9
#: Processes in one message at most; errors come first.
MOST_PROCESSES: Final = 500
_ORDER: Final = (Level.ERROR, Level.STALE, Level.WARN)
_HOST: Final[Mapping[str, tuple[Level, str]]] = {
    "suspect": (Level.WARN, "suspect: its reports are late"),
    "detached": (Level.WARN, "detached: its slave was stopped and left processes running"),
    "lost": (Level.ERROR, "lost: it was silent for its whole lease"),
    "expected": (Level.STALE, "silent since the master started"),
    "left": (Level.OK, "left: its slave was stopped"),
}
_PROCESS: Final[Mapping[str, Level]] = {
    "set_aside": Level.WARN, "backoff": Level.WARN,
    "failed": Level.ERROR, "unreachable": Level.ERROR, "stuck": Level.ERROR,
    "unknown": Level.STALE,
}  # fmt: skip
_UNWELL_PHASES: Final = frozenset(phase for phase in ProcessPhase if phase.value in _PROCESS)


def diagnostics(state: MasterState, now: float, master: str, trouble: str) -> list[Diagnostic]:
    """Return the statuses of the master, of all hosts, and of processes that are not well.

    Args:
        master: name of the master.
        trouble: why the master accepts no new work; "": it does.
    """
    hosts = host_rows(state, now)
    silent = {row.description.name for row in hosts if row.state not in ("up", "left")}
    unwell = []
    for process in state.processes.values():
        if _may_be_unwell(state, process, silent):
            status = of_process(process_row(state, process, now))
            if status.level is not Level.OK:
                unwell.append(status)
    unwell.sort(key=lambda one: _ORDER.index(one.level))
    processes = counted(len(state.processes), "process", "processes")
    message = trouble or f"{counted(len(hosts), 'host')}; {processes}, {len(unwell)} not well"
    own = Diagnostic(("master", master), Level.ERROR if trouble else Level.OK, first_line(message))
    return [own, *map(of_host, hosts), *unwell[:MOST_PROCESSES]]


def of_subject(state: MasterState, now: float, subject: Subject) -> Diagnostic:
    """Return the status of a host or process, also of one that is well or no longer listed."""
    kind, name = subject
    host, process = state.hosts.by_name.get(name), state.processes.get(name)
    if kind == "host" and host is not None and not host.pruned:
        return of_host(host_row(state, host, now))
    if kind == "process" and process is not None:
        return of_process(process_row(state, process, now))
    return Diagnostic(subject, Level.OK, "no longer listed")


def of_host(row: HostRow) -> Diagnostic:
    """Return the status of a host."""
    name = row.description.name
    level, message = _HOST.get(row.state) or _of_reporting_host(row)
    values = {
        "state": row.state, "hostname": row.description.hostname, "processes": str(row.processes)
    }  # fmt: skip
    for one in row.resources:
        values[one.name] = f"{percent(one.usage)} % of at most {percent(one.limit)} %"
    return Diagnostic(("host", name), level, message, name, values)


def _of_reporting_host(row: HostRow) -> tuple[Level, str]:
    old = [one.name for one in row.resources if one.stale]
    if old and len(old) == len(row.resources):
        return Level.STALE, "all its readings are old"
    near = [
        f"{one.name} {percent(one.usage)} % of at most {percent(one.limit)} %"
        for one in row.resources
        if not one.stale and one.usage >= _NEAR * one.limit
    ]
    faults = [*near, *([f"old readings of {listed(old)}"] if old else [])]
    closed = ", draining" if row.draining else ", cordoned" if row.cordoned else ""
    return (Level.WARN, ", ".join(faults)) if faults else (Level.OK, f"up{closed}")


def _may_be_unwell(state: MasterState, process: Process, silent: set[str]) -> bool:
    """Return False for most processes that are well; a row of each would take too long."""
    if process.phase in _UNWELL_PHASES:
        return True
    owner = state.owner_of(process)
    return owner is not None and (owner.host.name in silent or "limits.memory" in owner.enforced)


def of_process(row: ProcessRow) -> Diagnostic:
    """Return the status of a process; details of its reason are for its owner only."""
    level, message = _PROCESS.get(row.state, Level.OK), standing(row.state)
    if level is Level.OK and row.memory_limit and row.memory >= _NEAR * row.memory_limit:
        level, message = Level.WARN, f"uses {size(row.memory)} of at most {size(row.memory_limit)}"
    elif row.reason:
        message += f": {first_line(row.reason)}"
    values = {
        "state": row.state, "number": str(row.number), "restarts": str(row.restarts),
        "application": row.application,
    }  # fmt: skip
    return Diagnostic(("process", row.name), level, message, row.host, values)
