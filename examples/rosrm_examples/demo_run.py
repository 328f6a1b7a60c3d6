"""Run of a demo: start the cluster, carry out its script, watch until it is over."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Final, Protocol

from rosrm import Client, InstanceId, Listing, ProcessRow, RosrmError, Target
from rosrm.supervisor.client import log_path
from rosrm.testing.local_cluster import LocalCluster, Part
from rosrm_examples.demo_job import Arrival
from rosrm_examples.demo_page import DemoPage
from rosrm_examples.demo_record import ENDED, Record
from rosrm_examples.demo_screen import Screen

_START_S: Final = 60.0
#: Seconds; a demo that takes longer has failed.
_LONGEST_S: Final = 150.0
_SAMPLE_S: Final = 0.2
_SPIN_S: Final = 0.05
_WRONG: Final = frozenset({"failed", "cancelled", "set_aside", "stuck"})


class DemoFailed(Exception):
    """The demo did not reach its end; the text gives the reason, and the log to read."""


class Stopped(Exception):
    """A signal stopped the demo.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class StopSignals:
    """Recorder of SIGINT, SIGTERM and SIGHUP; the demo polls it, and so never stops halfway."""

    def __init__(self) -> None:
        self._came: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._note)

    def _note(self, number: int, _: FrameType | None) -> None:
        self._came = number

    def check(self) -> None:
        """Raise `Stopped` when a signal has come."""
        if self._came is not None:
            raise Stopped(self._came)


class Script(Protocol):
    """The actions of a demo, and its end."""

    def act(self, client: Client, elapsed: float) -> None:
        """Do the actions that are due, `elapsed` seconds after the beginning; called repeatedly."""

    def is_over(self, view: Listing) -> bool:
        """Return True if nothing is left to do or to wait for, by hosts and processes."""


class Arrivals:
    """A script that requests processes at their times, and ends when all of them have ended."""

    def __init__(self, coming: Sequence[Arrival]) -> None:
        self._left = list(coming)

    def act(self, client: Client, elapsed: float) -> None:
        """Apply the applications, and submit the single processes, that are due."""
        while self._left and self._left[0].at <= elapsed:
            arrival = self._left.pop(0)
            if arrival.application:
                client.apply_targets([Target(arrival.application, arrival.specs)])
            else:
                client.submit(arrival.specs)

    def is_over(self, view: Listing) -> bool:
        """Return True if all processes have been submitted and have ended."""
        return not self._left and all(row.state in ENDED for row in view.processes)


class Demo:
    """One run of a demo on a cluster of its own."""

    def __init__(
        self, cluster: LocalCluster, record: Record, screen: Screen, signals: StopSignals
    ) -> None:
        """Prepare the run; nothing is started.

        Args:
            cluster: to be started, and ended.
            record: for all observations.
        """
        self.record = record
        self._screen = screen
        self._signals = signals
        self._cluster = cluster
        self._page: DemoPage | None = None

    def carry_out(self, script: Script) -> Sequence[ProcessRow]:
        """Carry out a script; return the processes with their states at the end.

        Raises:
            DemoFailed: a process failed, a part of rosrm died, or it took too long.
            Stopped: by a signal.
        """
        try:
            self._start_cluster()
            with closing(self._screen):
                return self._run(script)
        except (RosrmError, TimeoutError):
            self._signals.check()  # which came during a request that failed, such as the first one
            self._check_parts()  # the error of a part that has died is more precise than a timeout
            raise
        finally:
            if self._page is not None:
                self._page.close()
            self._cluster.close()

    def _start_cluster(self) -> None:
        self._cluster.start_master()
        for host in self._cluster.hosts:
            self._cluster.start_slave(host)
        self._page = DemoPage(self._cluster.ros, self._cluster.directory / "web.log")
        self._cluster.wait_until("every host accepting work", self._all_accept, _START_S)

    def _all_accept(self, view: Listing) -> bool:
        self._signals.check()
        return sum(row.accepting for row in view.hosts) == len(self._cluster.hosts)

    def _run(self, script: Script) -> Sequence[ProcessRow]:
        began = time.monotonic()
        next_look = 0.0
        client = Client(connection=self._cluster.client)
        while True:
            self._signals.check()
            self._check_parts()
            if news := self._page.news() if self._page is not None else "":
                self._screen.say(news)
            elapsed = time.monotonic() - began
            script.act(client, elapsed)
            if elapsed >= next_look:
                view = self._look(elapsed)
                if script.is_over(view):
                    return view.processes
                if elapsed > _LONGEST_S:
                    raise self._too_long(view.processes)
                next_look = max(next_look + _SAMPLE_S, elapsed)
            self._cluster.client.spin(_SPIN_S)

    def _look(self, elapsed: float) -> Listing:
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
        directory = self._cluster.directory
        reason = row.reason or f"exit code {row.exit_code}"
        found = self.record.last_instance(row.name)
        if found is None:
            return f"{row.name} is {row.state}: {reason}; see {directory / 'master.log'}"
        host, number = found
        log = log_path(directory / "hosts" / host / "supervisor", InstanceId(row.name, number))
        return f"{row.name} {row.state} on {host}: {reason}; see {log}{_last_words(log)}"

    def _too_long(self, rows: Sequence[ProcessRow]) -> DemoFailed:
        late = [f"{row.name} is {row.state}" for row in rows if row.state not in ENDED]
        more = f" and {len(late) - 5} more" if len(late) > 5 else ""
        return DemoFailed(
            f"not done after {_LONGEST_S:.0f} s: {', '.join(late[:5])}{more}; "
            f"see the logs in {self._cluster.directory}"
        )


def _last_words(log: Path) -> str:
    """Return the last line that a process wrote, as a line of its own."""
    try:
        lines = log.read_text(errors="replace").split("\n")
    except OSError:
        return ""
    written = [line for line in lines if line.strip()]
    return f"\n  its last line: {written[-1].strip()}" if written else ""
