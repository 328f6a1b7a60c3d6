"""Stalls of slaves and master: one waited for a processor for long enough to be silent, by /proc.

Imports nothing from rosrm. A stall alone excuses nothing: a host must have recorded a fence, or the
master a silent host.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, NamedTuple

from benchmarks.chaos.allowances import FENCED, OVERLOAD, Disturbance
from benchmarks.chaos.faults import MASTER

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds between two samples.
_PERIOD: Final = 0.25
#: Longest stall as a multiple of its waits: the part may run for moments in between.
_WITHIN: Final = 1.2
#: Begin of the reason of a fence that ended an instance because a contact was missing.
_NO_CONTACT: Final = "fenced: no "


class StallMeter:
    """Measure of the stalls of a slave or of the master.

    Args:
        part: host of the slave, or `MASTER`, which concerns all hosts.
        lease: of the hosts, in seconds.

    Attributes:
        stalls: of at least `FENCED` seconds, in order; those that overlap are one.
    """

    def __init__(self, part: str, lease: float) -> None:
        self._part = part
        self._lease = lease
        self._samples: deque[tuple[float, Mapping[str, float]]] = deque()
        self.stalls: list[Disturbance] = []

    def add(self, now: float, waited: Mapping[str, float]) -> None:
        """Add a sample.

        Args:
            now: monotonic time.
            waited: by thread of the part, the seconds for which it has ever waited.
        """
        self._samples.append((now, waited))
        while self._samples[0][0] < now - _WITHIN * self._lease:
            self._samples.popleft()
        for then, earlier in self._samples:  # the oldest one that it has waited since
            common = waited.keys() & earlier
            longest = max((waited[one] - earlier[one] for one in common), default=0.0)
            if longest > FENCED and _WITHIN * longest >= now - then:
                # The kernel adds a wait at its end, so it may have begun before that sample.
                self._add_stall(min(then, now - longest), now)
                return

    def _add_stall(self, begun: float, ended: float) -> None:
        if self.stalls and begun <= self.stalls[-1].ended:
            begun = min(begun, self.stalls.pop().begun)
        hosts = frozenset({"*" if self._part == MASTER else self._part})
        deafens = self._part != MASTER
        self.stalls.append(Disturbance(OVERLOAD, begun, ended, hosts, hides=True, deafens=deafens))


class StallWatch:
    """Thread that measures the stalls of master and slaves, from entry to exit.

    Args:
        parts: by part, a function that returns its pid on this machine, or 0.
        lease: of the hosts, in seconds.
    """

    def __init__(self, parts: Mapping[str, Callable[[], int]], lease: float) -> None:
        self._parts = parts
        self._meters = {part: StallMeter(part, lease) for part in parts}
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
            for part, meter in self._meters.items():
                waited = _waited(pids.get(part, 0))
                if not waited:
                    pids[part] = self._parts[part]()
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
    stalls: Iterable[Disturbance], silent: Iterable[tuple[float, str]], lease: float
) -> list[Disturbance]:
    """Return the stalls, longer than the lease, in which the master recorded a silent host.

    Args:
        stalls: that were measured.
        silent: monotonic time and host of each event "suspect" or "lost".
        lease: of the hosts, in seconds.
    """
    return [
        stall
        for stall in stalls
        if stall.ended - stall.begun > lease
        and any(
            host in stall.hosts and stall.begun <= when <= stall.ended + _PERIOD
            for when, host in silent
        )
    ]


class RecordedFence(NamedTuple):
    """A fence that ended an instance on a host without contact.

    Attributes:
        begun, ended: monotonic time of the last contact and of the fence: the silence between.
    """

    instance: str
    host: str
    begun: float
    ended: float


def read_fences(host: str, record: str) -> set[RecordedFence]:
    """Return the fences without contact in the instance record of a host's supervisor."""
    fences = set()
    for line in record.splitlines():
        if _NO_CONTACT not in line:
            continue
        with contextlib.suppress(ValueError):  # a line may be incomplete
            state = json.loads(line)
            if state.get("fenced", "").startswith(_NO_CONTACT):
                (name, number), begun, (after, *_) = state["key"], state["heard"], state["fence"]
                fences.add(RecordedFence(f"{name}#{number}", host, begun, begun + after))
    return fences


def before_fences(
    stalls: Iterable[Disturbance], fences: Iterable[RecordedFence]
) -> list[Disturbance]:
    """Return the stalls in the silence before each fence, as far as they last, for its instance."""
    return [
        replace(
            stall,
            begun=max(stall.begun, fence.begun),
            ended=min(stall.ended, fence.ended),
            hosts=frozenset({fence.host}),
            instance=fence.instance,
        )
        for stall in stalls
        for fence in fences
        if stall.concerns(fence.host) and stall.begun < fence.ended and fence.begun < stall.ended
    ]
