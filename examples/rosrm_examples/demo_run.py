"""Carries the demo out: starts the cluster, submits what comes, watches until all has ended."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Final

from rosrm.core.model import InstanceId
from rosrm.core.views import ProcessRow, Snapshot
from rosrm.errors import RosrmError
from rosrm.local_cluster import LocalCluster, Part
from rosrm.supervisor.client import log_path
from rosrm_examples.demo_job import (
    HOSTS,
    MEMORY_LIMIT,
    Arrival,
    Scenario,
    cluster_config,
    host_configs,
)
from rosrm_examples.demo_record import Record
from rosrm_examples.demo_screen import Screen

_START_S: Final = 30.0
#: Everything has ended by then, at any pace, or something is wrong.
_LONGEST_S: Final = 150.0
_SAMPLE_S: Final = 0.2
_SPIN_S: Final = 0.05
_OVER: Final = frozenset({"finished", "failed", "cancelled"})
_WRONG: Final = frozenset({"failed", "cancelled", "set_aside", "stuck"})


class DemoFailed(Exception):
    """The demo did not come to its end; the text says why, and where to look."""


class Stopped(Exception):
    """Somebody stopped the demo.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class StopSignals:
    """Notes SIGINT, SIGTERM and SIGHUP; the demo looks for them, and so stops nowhere halfway."""

    def __init__(self) -> None:
        self._came: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._note)

    def _note(self, number: int, _: FrameType | None) -> None:
        self._came = number

    def check(self) -> None:
        """Raises `Stopped` when a signal has come."""
        if self._came is not None:
            raise Stopped(self._came)


class Demo:
    """One run of the demo on a cluster of its own."""

    def __init__(
        self, scenario: Scenario, directory: Path, screen: Screen, signals: StopSignals
    ) -> None:
        """Prepares the run; nothing is started.

        Args:
            directory: for the states and logs of master and slaves.
        """
        hosts = host_configs(scenario.budget, os.cpu_count() or 1)
        self.record = Record(HOSTS, {"memory": MEMORY_LIMIT}, scenario.budget)
        self._screen = screen
        self._signals = signals
        self._directory = directory
        self._cluster = LocalCluster(directory, cluster_config(scenario.pace), hosts)

    def carry_out(self, coming: Sequence[Arrival]) -> Sequence[ProcessRow]:
        """Run everything; returns the processes as they were at the end.

        Raises:
            DemoFailed: a process failed, a part of rosrm died, or it took too long.
            Stopped: by a signal.
        """
        try:
            self._start_cluster()
            with closing(self._screen):
                return self._run(coming)
        except RosrmError:
            self._check_parts()  # a part that has died says it better than who waited for it
            raise
        finally:
            self._cluster.close()

    def _start_cluster(self) -> None:
        self._cluster.start_master()
        for host in self._cluster.hosts:
            self._cluster.start_slave(host)
        self._cluster.wait_until("three hosts that accept work", self._all_accept, _START_S)

    def _all_accept(self, view: Snapshot) -> bool:
        self._signals.check()
        return sum(row.accepting for row in view.hosts) == len(self._cluster.hosts)

    def _run(self, coming: Sequence[Arrival]) -> Sequence[ProcessRow]:
        began = time.monotonic()
        left, next_look = list(coming), 0.0
        while True:
            self._signals.check()
            self._check_parts()
            elapsed = time.monotonic() - began
            self._submit_due(left, elapsed)
            if elapsed >= next_look:
                view = self._look(elapsed)
                if not left and all(row.state in _OVER for row in view.processes):
                    return view.processes
                if elapsed > _LONGEST_S:
                    raise self._too_long(view.processes)
                next_look = max(next_look + _SAMPLE_S, elapsed)
            self._cluster.client.spin(_SPIN_S)

    def _submit_due(self, left: list[Arrival], elapsed: float) -> None:
        while left and left[0].at <= elapsed:
            self._cluster.client.submit(left.pop(0).specs)

    def _look(self, elapsed: float) -> Snapshot:
        view = self._cluster.client.list(
            hosts=True, processes=True, events=True, after=self.record.last_sequence
        )
        view = replace(view, hosts=sorted(view.hosts, key=lambda row: row.description.name))
        self.record.add(view)
        self._screen.show(view, elapsed)
        for row in view.processes:
            if row.state in _WRONG:
                raise DemoFailed(self._what_happened(row))
        return view

    # --- what can go wrong ---------------------------------------------------------------

    def _check_parts(self) -> None:
        for part in self._parts():
            code = part.process.poll()
            if code is not None:
                raise DemoFailed(f"{part.name} ended with exit code {code}; see {part.log}")

    def _parts(self) -> Iterable[Part]:
        master = self._cluster.master
        return [*([master] if master else []), *self._cluster.slaves.values()]

    def _what_happened(self, row: ProcessRow) -> str:
        reason = row.reason or f"exit code {row.exit_code}"
        found = self.record.last_instance(row.name)
        if found is None:
            return f"{row.name} is {row.state}: {reason}; see {self._directory / 'master.log'}"
        host, number = found
        log = log_path(
            self._directory / "hosts" / host / "supervisor", InstanceId(row.name, number)
        )
        return f"{row.name} {row.state} on {host}: {reason}; see {log}{_last_words(log)}"

    def _too_long(self, rows: Sequence[ProcessRow]) -> DemoFailed:
        late = [f"{row.name} is {row.state}" for row in rows if row.state not in _OVER]
        more = f" and {len(late) - 5} more" if len(late) > 5 else ""
        return DemoFailed(
            f"not done after {_LONGEST_S:.0f} s: {', '.join(late[:5])}{more}; "
            f"see the logs in {self._directory}"
        )


def _last_words(log: Path) -> str:
    """The last line that a process wrote, as a line of its own."""
    try:
        lines = log.read_text(errors="replace").split("\n")
    except OSError:
        return ""
    written = [line for line in lines if line.strip()]
    return f"\n  its last line: {written[-1].strip()}" if written else ""
