"""Stalls of hosts: a slave waited for a processor for longer than the lease, by /proc.

Imports nothing from rosrm.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

from benchmarks.chaos.allowances import OVERLOAD, Disturbance

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds between two samples.
_PERIOD: Final = 0.25
#: Leases within which the waits have to add up to one: the slave may run for moments in between.
_WITHIN: Final = 1.2


class StallMeter:
    """Measure of the stalls of one host.

    Args:
        host: its name.
        lease: seconds of waiting that make a stall.

    Attributes:
        stalls: in order; those that overlap are one.
    """

    def __init__(self, host: str, lease: float) -> None:
        self._host = host
        self._lease = lease
        self._samples: deque[tuple[float, Mapping[str, float]]] = deque()
        self.stalls: list[Disturbance] = []

    def add(self, now: float, waited: Mapping[str, float]) -> None:
        """Add a sample.

        Args:
            now: monotonic time.
            waited: by thread of the slave, the seconds for which it has ever waited.
        """
        self._samples.append((now, waited))
        while self._samples[0][0] < now - _WITHIN * self._lease:
            self._samples.popleft()
        earlier = self._samples[0][1]
        longest = max((waited[one] - earlier[one] for one in waited.keys() & earlier), default=0.0)
        if longest <= self._lease:
            return
        # The kernel adds a wait at its end, so it may have begun before the first sample.
        begun = min(self._samples[0][0], now - longest)
        if self.stalls and begun <= self.stalls[-1].ended:
            begun = self.stalls.pop().begun
        hosts = frozenset({self._host})
        self.stalls.append(Disturbance(OVERLOAD, begun, now, hosts, hides=True, deafens=True))


class StallWatch:
    """Thread that measures the stalls of all hosts, from entry to exit.

    Args:
        slaves: by host, a function that returns the pid of its slave on this machine, or 0.
        lease: of the hosts, in seconds.
    """

    def __init__(self, slaves: Mapping[str, Callable[[], int]], lease: float) -> None:
        self._slaves = slaves
        self._meters = {host: StallMeter(host, lease) for host in slaves}
        self._lock = threading.Lock()
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="stall watch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leaving.set()
        self._thread.join()

    def take(self) -> list[Disturbance]:
        """Return the stalls since the last call."""
        with self._lock:
            found = [stall for meter in self._meters.values() for stall in meter.stalls]
            for meter in self._meters.values():
                meter.stalls = []
        return found

    def _watch(self) -> None:
        pids: dict[str, int] = {}
        while not self._leaving.wait(_PERIOD):
            for host, meter in self._meters.items():
                waited = _waited(pids.get(host, 0))
                if not waited:
                    pids[host] = self._slaves[host]()
                with self._lock:
                    meter.add(time.monotonic(), waited)


def _waited(pid: int) -> dict[str, float]:
    """Return the seconds for which each thread of a process has waited for a processor."""
    waited = {}
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                nanoseconds = (thread / "schedstat").read_text().split()[1]
                waited[thread.name] = int(nanoseconds) / 1e9
    return waited


def confirmed(
    stalls: Iterable[Disturbance], silent: Iterable[tuple[float, str]]
) -> list[Disturbance]:
    """Return the stalls in which the master recorded that the host was silent.

    Args:
        stalls: that were measured.
        silent: monotonic time and host of each event "suspect" or "lost".
    """
    return [
        stall
        for stall in stalls
        if any(
            stall.concerns(host) and stall.begun <= when <= stall.ended + _PERIOD
            for when, host in silent
        )
    ]
