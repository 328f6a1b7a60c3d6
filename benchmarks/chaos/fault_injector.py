"""Fault injector: it does the faults, undoes them, and records what each may explain."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

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

Undo = Callable[[], bool]


class FaultInjector:
    """The faults that a cluster can suffer; a fault without a target to strike is skipped."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._lab = cluster.lab
        self._undos: dict[int, tuple[Disturbance, Undo]] = {}
        self.done: list[Disturbance] = []

    def begin(self, fault: Fault) -> str:
        """Do a fault; return the reason why it was skipped, "" where it was done."""
        do: Callable[[Fault], tuple[Disturbance, Undo] | str] = getattr(self, f"_{fault.kind}")
        outcome = do(fault)
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
        if not undo():
            return False
        del self._undos[fault.number]
        self.done.append(replace(disturbance, ended=time.monotonic()))
        return True

    def take_done(self) -> list[Disturbance]:
        """Return the disturbances that ended since the last call."""
        done, self.done = self.done, []
        return done

    # --- master and slaves --------------------------------------------------------------------

    def _master_kill(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._kill_part(fault, MASTER, _ALL)

    def _slave_kill(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._kill_part(fault, fault.target, frozenset({fault.target}))

    def _kill_part(
        self, fault: Fault, part: str, hosts: frozenset[str]
    ) -> tuple[Disturbance, Undo] | str:
        begun = time.monotonic()
        if not self._cluster.kill(part):
            return "it does not run"

        def start() -> bool:
            self._cluster.start(part)
            return True

        deafens = part != MASTER  # fences wait for a slave that works
        disturbance = Disturbance(
            fault.kind, begun, begun, hosts, hides=True, restarts=True, deafens=deafens
        )
        return disturbance, start

    def _master_stop(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._stop_part(fault, MASTER, _ALL)

    def _slave_stop(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._stop_part(fault, fault.target, frozenset({fault.target}))

    def _stop_part(
        self, fault: Fault, part: str, hosts: frozenset[str]
    ) -> tuple[Disturbance, Undo] | str:
        pid = self._cluster.parts[part].pid
        if not pid:
            return "it does not run"
        os.kill(pid, signal.SIGSTOP)
        deafens = part != MASTER
        disturbance = Disturbance(
            fault.kind, time.monotonic(), 0.0, hosts, hides=True, deafens=deafens
        )
        return disturbance, lambda: self._cluster.proceed(part)

    def _master_clock(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._set_clock(fault, MASTER)

    def _host_clock(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._set_clock(fault, fault.target)

    def _set_clock(self, fault: Fault, part: str) -> tuple[Disturbance, Undo] | str:
        if clocks.library() is None:
            return "libfaketime is not here"
        clocks.set_back(self._cluster.folder, part, fault.amount)

        def set_right() -> bool:
            clocks.set_back(self._cluster.folder, part, 0.0)
            return True

        return Disturbance(fault.kind, time.monotonic(), 0.0), set_right

    # --- supervisors and processes ------------------------------------------------------------

    def _supervisor_kill(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._signal_supervisor(fault, signal.SIGKILL)

    def _supervisor_stop(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._signal_supervisor(fault, signal.SIGSTOP)

    def _signal_supervisor(self, fault: Fault, number: int) -> tuple[Disturbance, Undo] | str:
        pid = self._cluster.supervisor(fault.target)
        outcome = self._signal(fault, pid, number, frozenset({fault.target}))
        if isinstance(outcome, str):
            return outcome
        disturbance, undo = outcome
        # A new supervisor continues from the last recorded contact, and ends nothing.
        killed = number == signal.SIGKILL
        return replace(disturbance, forgets=killed, deafens=not killed), undo

    def _process_kill(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._signal_process(fault, signal.SIGKILL)

    def _process_stop(self, fault: Fault) -> tuple[Disturbance, Undo] | str:
        return self._signal_process(fault, signal.SIGSTOP)

    def _signal_process(self, fault: Fault, number: int) -> tuple[Disturbance, Undo] | str:
        """Signal the first process of the oldest instance."""
        those = [one for one in members(self._lab.name) if one.process == fault.target]
        pid = min((one.pid for one in those), default=0)
        return self._signal(fault, pid, number, frozenset(), fault.target)

    def _signal(
        self, fault: Fault, pid: int, number: int, hosts: frozenset[str], process: str = ""
    ) -> tuple[Disturbance, Undo] | str:
        begun = time.monotonic()
        try:
            os.kill(pid, number) if pid else None
        except ProcessLookupError:
            pid = 0
        if not pid:
            return "it does not run"

        def proceed() -> bool:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
            return True

        return Disturbance(fault.kind, begun, begun, hosts, process), proceed

    # --- hosts --------------------------------------------------------------------------------

    def _master_cut(self, fault: Fault) -> tuple[Disturbance, Undo]:
        return self._cut(fault, DESK, "both", _ALL)

    def _host_cut(self, fault: Fault) -> tuple[Disturbance, Undo]:
        return self._cut(fault, fault.target, "both")

    def _host_cut_in(self, fault: Fault) -> tuple[Disturbance, Undo]:
        return self._cut(fault, fault.target, "in")

    def _host_cut_out(self, fault: Fault) -> tuple[Disturbance, Undo]:
        return self._cut(fault, fault.target, "out")

    def _cut(
        self, fault: Fault, host: str, direction: Direction, hosts: frozenset[str] = frozenset()
    ) -> tuple[Disturbance, Undo]:
        begun = time.monotonic()
        self._lab.cut(host, direction)
        return self._hidden(fault, begun, hosts or frozenset({host})), lambda: self._heal(host)

    def _host_loss(self, fault: Fault) -> tuple[Disturbance, Undo]:
        begun, host = time.monotonic(), fault.target
        self._lab.loss(host, fault.amount)
        return self._hidden(fault, begun, frozenset({host})), lambda: self._heal(host)

    def _hidden(self, fault: Fault, begun: float, hosts: frozenset[str]) -> Disturbance:
        return Disturbance(fault.kind, begun, begun, hosts, hides=True)

    def _heal(self, host: str) -> bool:
        self._lab.heal(host)
        return True

    def _host_off(self, fault: Fault) -> tuple[Disturbance, Undo]:
        host, begun = fault.target, time.monotonic()
        self._cluster.hold(host)
        self._lab.kill(host)

        def boot() -> bool:
            self._lab.boot(host)
            self._cluster.start(host)
            return True

        hosts = frozenset({host})
        return Disturbance(
            fault.kind, begun, begun, hosts, kills=True, hides=True, restarts=True
        ), boot

    # --- disks --------------------------------------------------------------------------------

    def _disk_full(self, fault: Fault) -> tuple[Disturbance, Undo]:
        return self._fill(fault, fault.target), lambda: self._free(fault.target)

    def _master_disk_full(self, fault: Fault) -> tuple[Disturbance, Undo]:
        """Fill the master's disk: the master may end and is restarted; snapshots are elsewhere."""
        disturbance = self._fill(fault, DESK)
        disturbance = replace(disturbance, hosts=_ALL, hides=True, restarts=True, fills=False)
        return disturbance, lambda: self._free(DESK)

    def _fill(self, fault: Fault, host: str) -> Disturbance:
        begun = time.monotonic()
        _fill(self._lab.outside(host, _FILLER))
        return Disturbance(fault.kind, begun, begun, frozenset({host}), fills=True)

    def _free(self, host: str) -> bool:
        self._lab.outside(host, _FILLER).unlink(missing_ok=True)
        return True


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
