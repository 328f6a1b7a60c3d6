"""Fault injector: it does the faults, undoes them, and records what each may explain."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

from benchmarks.chaos import clocks
from benchmarks.chaos.allowances import Disturbance
from benchmarks.chaos.cluster import DESK, Cluster
from benchmarks.chaos.faults import MASTER, Fault
from benchmarks.chaos.reality import members
from rosrm_lab import Direction

_ALL: Final = frozenset({"*"})
_FILLER: Final = "filler"
#: Bytes of the smallest piece with which a file system is filled.
_LEAST: Final = 4096

#: Undoes a fault; False: another attempt is necessary.
Undo = Callable[[], object]
#: A fault that was done: what it may explain, and its undo.
Done = tuple[Disturbance, Undo]


class FaultInjector:
    """The faults that a cluster can suffer; a fault without a target to strike is skipped."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._lab = cluster.lab
        self._undos: dict[int, Done] = {}
        self.done: list[Disturbance] = []

    def begin(self, fault: Fault) -> str:
        """Do a fault; return the reason why it was skipped, "" where it was done."""
        outcome = self.ACTIONS[fault.kind](self, fault)
        if isinstance(outcome, str):
            return outcome
        if fault.lasts:
            self._undos[fault.number] = outcome
        else:
            self.done.append(replace(outcome[0], ended=time.monotonic()))
        return ""

    def end(self, fault: Fault) -> bool:
        """Undo a fault; False: another attempt is necessary."""
        if fault.number not in self._undos:
            return True
        disturbance, undo = self._undos[fault.number]
        if undo() is False:
            return False
        del self._undos[fault.number]
        self.done.append(replace(disturbance, ended=time.monotonic()))
        return True

    def take_done(self) -> list[Disturbance]:
        """Return the disturbances that ended since the last call."""
        done, self.done = self.done, []
        return done

    # --- master and slaves --------------------------------------------------------------------

    def _kill_part(self, fault: Fault) -> Done | str:
        disturbance = _of_part(fault, restarts=True)
        if not self._cluster.kill(fault.target):
            return "it does not run"
        return disturbance, partial(self._cluster.start, fault.target)

    def _stop_part(self, fault: Fault) -> Done | str:
        pid = self._cluster.parts[fault.target].pid
        if not pid:
            return "it does not run"
        os.kill(pid, signal.SIGSTOP)
        return _of_part(fault), partial(self._cluster.proceed, fault.target)

    def _set_clock(self, fault: Fault) -> Done | str:
        if clocks.library() is None:
            return "libfaketime is not here"
        set_back = partial(clocks.set_back, self._cluster.folder, fault.target)
        set_back(fault.amount)
        return _disturbance(fault), partial(set_back, 0.0)

    # --- supervisors and processes ------------------------------------------------------------

    def _signal_supervisor(self, fault: Fault, number: int) -> Done | str:
        # A new supervisor continues from the last recorded contact, and ends nothing.
        killed = number == signal.SIGKILL
        disturbance = _disturbance(fault, fault.target, forgets=killed, deafens=not killed)
        return _signalled(self._cluster.supervisor(fault.target), number, disturbance)

    def _signal_process(self, fault: Fault, number: int) -> Done | str:
        """Signal the first process of the oldest instance."""
        those = [one for one in members(self._lab.name) if one.process == fault.target]
        pid = min((one.pid for one in those), default=0)
        return _signalled(pid, number, _disturbance(fault, process=fault.target))

    # --- hosts --------------------------------------------------------------------------------

    def _cut(self, fault: Fault, direction: Direction = "both") -> Done:
        host = DESK if fault.target == MASTER else fault.target
        disturbance = _disturbance(fault, fault.target, hides=True)
        self._lab.cut(host, direction)
        return disturbance, partial(self._lab.heal, host)

    def _lose_packets(self, fault: Fault) -> Done:
        disturbance = _disturbance(fault, fault.target, hides=True)
        self._lab.loss(fault.target, fault.amount)
        return disturbance, partial(self._lab.heal, fault.target)

    def _switch_off(self, fault: Fault) -> Done:
        host = fault.target
        disturbance = _disturbance(fault, host, kills=True, hides=True, restarts=True)
        self._cluster.hold(host)
        self._lab.kill(host)

        def boot() -> None:
            self._lab.boot(host)
            self._cluster.start(host)

        return disturbance, boot

    # --- disks --------------------------------------------------------------------------------

    def _fill_disk(self, fault: Fault) -> Done:
        """Fill a disk; the master may end and is restarted, and no snapshot is on its disk."""
        master = fault.target == MASTER
        disturbance = _disturbance(
            fault, fault.target, hides=master, restarts=master, fills=not master
        )
        filler = partial(self._lab.outside, DESK if master else fault.target, _FILLER)
        _fill(filler())
        return disturbance, lambda: filler().unlink(missing_ok=True)

    #: How each kind of fault is done.
    ACTIONS: ClassVar[Mapping[str, Callable[..., Done | str]]] = {
        "master_kill": _kill_part,
        "slave_kill": _kill_part,
        "master_stop": _stop_part,
        "slave_stop": _stop_part,
        "master_clock": _set_clock,
        "host_clock": _set_clock,
        "supervisor_kill": partial(_signal_supervisor, number=signal.SIGKILL),
        "supervisor_stop": partial(_signal_supervisor, number=signal.SIGSTOP),
        "process_kill": partial(_signal_process, number=signal.SIGKILL),
        "process_stop": partial(_signal_process, number=signal.SIGSTOP),
        "master_cut": _cut,
        "host_cut": _cut,
        "host_cut_in": partial(_cut, direction="in"),
        "host_cut_out": partial(_cut, direction="out"),
        "host_loss": _lose_packets,
        "host_off": _switch_off,
        "disk_full": _fill_disk,
        "master_disk_full": _fill_disk,
    }


def _disturbance(fault: Fault, target: str = "", **effects: Any) -> Disturbance:
    """Return the disturbance by a fault from now on; a fault of the master concerns all hosts."""
    hosts = {"": frozenset[str](), MASTER: _ALL}.get(target, frozenset({target}))
    now = time.monotonic()
    return Disturbance(fault.kind, now, now, hosts, **effects)


def _of_part(fault: Fault, **effects: Any) -> Disturbance:
    """Return the disturbance by a silent part; a fence waits for a slave that works."""
    deafens = fault.target != MASTER
    return _disturbance(fault, fault.target, hides=True, deafens=deafens, **effects)


def _signalled(pid: int, number: int, disturbance: Disturbance) -> Done | str:
    """Send a signal to a process; its undo continues the process."""
    try:
        os.kill(pid, number) if pid else None
    except ProcessLookupError:
        pid = 0
    if not pid:
        return "it does not run"

    def proceed() -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)

    return disturbance, proceed


def _fill(path: Path) -> None:
    """Fill a file system, in ever smaller pieces."""
    with path.open("ab") as file:
        piece = 1 << 26
        while piece >= _LEAST:
            size = os.fstat(file.fileno()).st_size
            try:
                os.posix_fallocate(file.fileno(), size, piece)
            except OSError:
                piece //= 2
