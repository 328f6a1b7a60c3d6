"""Sampler of a host's probes that never waits for one.

The slave's 10 Hz loop is the only clock. Each call of `Sampler.latest` hands the probes that are
due to a thread, and returns the results of earlier reads. So it takes microseconds, independent of
the probes. The rules:

- A probe begins in a thread of its own. After ten quick reads in a row it moves to the thread that
  all quick probes share (one wake-up a cycle, not one a probe); one slow read moves it back.
- A slow read keeps the thread in which it hangs; probes queued behind it get a new thread at the
  next cycle. A probe is never read twice at a time, so a hanging probe costs one thread, however
  long it hangs.
- A probe that is late, raises or returns invalid values makes its readings *stale*: they keep their
  last value, never zero. The reason is reported once, and so is the recovery. A probe that changes
  often stays stale until its changes are rarer, so the mark and the newest report always agree.
  Only recoveries are held back in this way, never failures. Another error of a stale probe is
  reported at most every 10 s.
- Before its first reading a resource counts as full and stale, so that a host that was not measured
  attracts no work.

Readings are one cycle old. A read in the loop itself would save some 30 us a cycle, but then a
probe that was quick a thousand times could still block the loop at the next read.
"""

from __future__ import annotations

import math
import threading
from array import array
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from rosrm import clocks, threads
from rosrm.errors import PluginError
from rosrm.extensions.guard import guarded
from rosrm.extensions.plugin_calls import titled
from rosrm.model.devices import Device
from rosrm.model.values import EMPTY, MOST_USED, RESOURCE_SLOTS, ResourceDescription
from rosrm.slave.probe_reads import UsageByProcess, read_devices, read_processes, read_values

if TYPE_CHECKING:
    from rosrm.extensions.made import MadeProbe

_T = TypeVar("_T")

#: A read that takes longer, in seconds, is too slow to share a thread.
QUICK: Final = 0.05
#: Quick reads in a row after which a probe moves to the shared thread.
TRUSTED_AFTER: Final = 10
#: Most reports of one probe in REPORT_WINDOW seconds, so that a flapping probe floods no log.
REPORTS: Final = 6
REPORT_WINDOW: Final = 60.0
#: Seconds after a report before another error of a probe that is still stale is reported.
ANOTHER_ERROR: Final = 10.0


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """Change of a probe's readings to stale, or back.

    Attributes:
        probe: name of the probe.
        resources: names of the readings; none for a probe that could not be created and whose
            resources other probes read.
        stale: True if the readings became stale.
        reason: why they are stale; "" on recovery.
    """

    probe: str
    resources: tuple[str, ...]
    stale: bool
    reason: str

    def __str__(self) -> str:
        """Return one sentence for the event record."""
        names = ", ".join(self.resources)
        if self.stale and not names:
            return f"probe {self.probe} fails: {self.reason}"
        if self.stale:
            return f"probe {self.probe}: {names} stale: {self.reason}"
        return f"probe {self.probe}: {names} read again"


@dataclass(frozen=True, slots=True)
class Sample:
    """Newest readings of all probes.

    Attributes:
        usage: single-precision fractions of the capacity by slot; 0 where not in use.
        stale: bit i: the reading of slot i is older than its deadline.
        reports: changes since the previous sample.
    """

    usage: array[float]
    stale: int
    reports: tuple[ProbeReport, ...] = ()


class _Outcome(NamedTuple):
    """Result of a read.

    Attributes:
        values: in the order of the probe's resources; () after a failure.
        by_process: usage of single processes, as measured after that.
        devices: devices that the probe found; None: that failed.
        reason: of a failure; "" otherwise.
        seconds: duration of the read.
        age: seconds since the read was queued, which can be much longer on a busy machine.
        began: when the read began.
    """

    values: tuple[float, ...]
    by_process: UsageByProcess
    devices: tuple[Device, ...] | None
    reason: str
    seconds: float
    age: float
    began: float


class Finding(NamedTuple):
    """Devices that a probe found, and when that read began."""

    devices: tuple[Device, ...]
    at: float


class Sampler:
    """Background reader of probes; one loop calls `latest`, which never waits.

    Args:
        probes: created and checked by the registry; the order of their resources gives the
            slots.
        clock: monotonic seconds, the same as the `now` of `latest`.
    """

    def __init__(
        self, probes: Sequence[MadeProbe], *, clock: Callable[[], float] = clocks.boot_time
    ) -> None:
        self.resources: tuple[ResourceDescription, ...] = ()
        self._clock = clock
        self._progress = threading.Event()
        self._shared = _Lane("rosrm-probes")
        self._left: list[_Lane] = []
        self._watched: list[_Watched] = []
        self._usage = [0.0] * RESOURCE_SLOTS
        self._by_process: dict[int, Mapping[int, float]] = {}
        self._devices: dict[str, Finding] = {}
        self.rearrange(probes)

    def rearrange(self, probes: Sequence[MadeProbe]) -> tuple[MadeProbe, ...]:
        """Read these probes from now on; return the former ones that are read no more.

        A probe that stays keeps its readings, maybe in other slots; a new one is full and stale.
        """
        before = dict(zip((one.name for one in self.resources), self._usage, strict=False))
        amounts = {self.resources[slot].name: one for slot, one in self._by_process.items()}
        former = {id(watched.made): watched for watched in self._watched}
        self.resources = tuple(resource for made in probes for resource in made.resources)
        self._watched = [
            former.pop(id(made))
            if id(made) in former
            else _Watched(made, self._clock, self._progress)
            for made in probes
        ]
        first = 0
        for watched in self._watched:
            watched.slots = slice(first, first + len(watched.names))
            first += len(watched.names)
        names = [one.name for one in self.resources]
        self._usage[:] = [before.get(name, 1.0) for name in names]
        self._usage += [0.0] * (RESOURCE_SLOTS - len(names))
        self._by_process = {
            slot: amounts[name] for slot, name in enumerate(names) if name in amounts
        }
        for watched in former.values():
            self._devices.pop(watched.name, None)
            watched.lane.put(watched.close)
            if watched.lane is not self._shared:
                watched.lane.end()
                self._left.append(watched.lane)
        return tuple(watched.made for watched in former.values())

    @property
    def present(self) -> int:
        """Return a bit mask; bit i: slot i is in use."""
        return (1 << len(self.resources)) - 1

    @property
    def by_process(self) -> Mapping[int, Mapping[int, float]]:
        """Return slot to pid to amount, measured for the newest readings, but cpu and memory."""
        return self._by_process

    @property
    def devices(self) -> Mapping[str, Finding]:
        """Return the name of each probe to the devices that it found last."""
        return self._devices

    @property
    def awaits_devices(self) -> bool:
        """Return True if a probe may find devices, but has not answered which."""
        return any(one.name not in self._devices for one in self._watched)

    def latest(self, now: float) -> Sample:
        """Return the newest readings, and queue a read of each probe that is due. Never waits."""
        reports: list[ProbeReport] = []
        stale = 0
        for watched in self._watched:
            if watched.busy:
                self._check_running_read(watched, now)
            elif watched.outcome is not None:
                self._take_outcome(watched, watched.outcome)
            if watched.reason or watched.is_stale:
                reports += watched.report(now)
                stale |= watched.mask if watched.is_stale else 0
            if now >= watched.due and not watched.busy:
                watched.lane.put(watched.prepare(now))
        return Sample(array("f", self._usage), stale, tuple(reports))

    def settle(self, timeout: float) -> bool:
        """Wait until no read is running; return False if one still runs after `timeout` seconds."""
        end = clocks.boot_time() + timeout
        while any(watched.busy for watched in self._watched):
            if not self._progress.wait(max(0.0, end - clocks.boot_time())):
                return False
            self._progress.clear()
        return True

    def first(self, timeout: float = 2.0) -> Sample:
        """Read every probe once, wait for the answers, and return the sample for the registration.

        A probe without an answer after `timeout` seconds stays stale.
        """
        reports = self.latest(self._clock()).reports
        self.settle(timeout)
        sample = self.latest(self._clock())
        return Sample(sample.usage, sample.stale, reports + sample.reports)

    def close(self, timeout: float = 2.0) -> tuple[str, ...]:
        """Close every probe, each in the thread that reads it; no further call may follow.

        After `timeout` seconds in all, return the probes that hang or raised, and so stay unclosed.
        """
        for watched in self._watched:
            # A probe that hangs in its own thread must not be closed during its read.
            if watched.lane.alive() or not watched.busy:
                watched.lane.put(watched.close)
        lanes = {id(lane): lane for lane in [*(w.lane for w in self._watched), self._shared]}
        end = clocks.boot_time() + timeout
        for lane in lanes.values():
            lane.end()
        for lane in [*lanes.values(), *self._left]:
            lane.join(max(0.0, end - clocks.boot_time()))
        return tuple(watched.name for watched in self._watched if not watched.closed)

    def _check_running_read(self, watched: _Watched, now: float) -> None:
        """Check a running read: move the queue behind a slow one, and mark a late one."""
        if watched.running(now) > QUICK and watched.lane is self._shared:
            stuck, self._shared = self._shared, self._shared.succeed()
            for other in self._watched:
                if other.lane is stuck:
                    other.lane = self._shared
            watched.lane = _Lane(f"rosrm-probe-{watched.name}")
        if now - watched.asked > watched.deadline:
            watched.reason = f"no answer within {watched.deadline:g} s"

    def _take_outcome(self, watched: _Watched, outcome: _Outcome) -> None:
        """Store the values of a finished read, and choose the thread of the next read."""
        watched.outcome, watched.measured = None, True
        if outcome.devices is not None:
            self._devices[watched.name] = Finding(outcome.devices, outcome.began)
        if outcome.values:
            self._usage[watched.slots] = outcome.values
            for name, amounts in outcome.by_process.items():
                if name not in MOST_USED:  # the slave measures cpu and memory of sessions itself
                    self._by_process[watched.slots.start + watched.names.index(name)] = amounts
        late = outcome.age > watched.deadline
        watched.reason = f"answered after {outcome.age:.3g} s" if late else outcome.reason
        self._choose_lane(watched, outcome.seconds)

    def _choose_lane(self, watched: _Watched, seconds: float) -> None:
        if seconds > QUICK:
            watched.quick_reads = 0
            if watched.lane is self._shared:
                watched.lane = _Lane(f"rosrm-probe-{watched.name}")
            return
        watched.quick_reads += 1
        if watched.quick_reads >= TRUSTED_AFTER and watched.lane is not self._shared:
            watched.lane.end()
            self._left = [lane for lane in self._left if lane.alive()] + [watched.lane]
            watched.lane = self._shared


class _Lane:
    """Thread that executes queued calls in order, started with the first call."""

    def __init__(
        self, name: str, queue: SimpleQueue[Callable[[], None] | None] | None = None
    ) -> None:
        self._name = name
        self._queue: SimpleQueue[Callable[[], None] | None] = queue or SimpleQueue()
        self._thread: threads.Thread | None = None
        self._dismissed = False

    def put(self, call: Callable[[], None]) -> None:
        """Queue a call."""
        if self._thread is None:
            self._start()
        self._queue.put(call)

    def succeed(self) -> _Lane:
        """Move the queue to a new thread, and leave the old one to the call in which it hangs."""
        self._dismissed = True
        lane = _Lane(self._name, self._queue)
        lane._start()
        return lane

    def end(self) -> None:
        """End the thread after all queued calls."""
        self._queue.put(None)

    def alive(self) -> bool:
        """Return True if the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def join(self, timeout: float) -> None:
        """Wait at most `timeout` seconds for the end of the thread."""
        if self._thread is not None:
            self._thread.join(timeout)

    def _start(self) -> None:
        # A daemon, because a probe that hangs in the kernel must not keep the slave from ending.
        with suppress(RuntimeError):  # no further thread: the probe is late, and the next put tries
            self._thread = threads.start(self._serve, self._name, again=True)

    def _serve(self) -> None:
        # No time-out is needed, because the queue always ends with the None of `end`.
        while (call := self._queue.get()) is not None:
            call()
            if self._dismissed:
                return
        if self._dismissed:  # it took the None of its successor
            self._queue.put(None)


class _Watched:
    """One probe with the state of its reads.

    `busy` passes the ownership between the threads. While it is True, only the reading thread
    writes `_started` and `outcome`, and clears `busy` last. While it is False, only the loop
    writes.
    """

    def __init__(
        self, made: MadeProbe, clock: Callable[[], float], progress: threading.Event
    ) -> None:
        self.made = made
        self.name = made.name
        self._title = titled("probe", made.name)
        self.names = tuple(resource.name for resource in made.resources)
        self.deadline = made.deadline
        self.slots = slice(0, 0)  # set by the sampler
        self.lane = _Lane(f"rosrm-probe-{made.name}")
        self.quick_reads = 0
        self.reason = ""
        self.busy = False
        self.asked = -math.inf
        self.closed = False
        self.outcome: _Outcome | None = None
        self._started: float | None = None
        self._probe = made.probe
        self._resources = made.resources
        self._period = made.period
        self._clock = clock
        self._progress = progress
        self.due = self._nominal = -math.inf
        self.measured = False
        self._reported_stale = False
        self._reported = ""
        self._reported_at = -math.inf
        self._report_times: list[float] = []

    def prepare(self, now: float) -> Callable[[], None]:
        """Return the read to queue, which counts as running from now on."""
        following = self._nominal + self._period
        self._nominal = following if following > now else now + self._period
        # Due a quarter of a period early, so that jitter skips no cycle.
        self.due = self._nominal - self._period / 4
        self._started = None
        self.asked = now
        self.busy = True
        return self._read

    @property
    def mask(self) -> int:
        """Return the bits of its slots."""
        return (1 << self.slots.stop) - (1 << self.slots.start)

    def running(self, now: float) -> float:
        """Return the seconds since the running read began; 0 while it is queued."""
        return 0.0 if self._started is None else now - self._started

    @property
    def is_stale(self) -> bool:
        """Return True if the newest report was of stale readings, or there is no reading yet."""
        return self._reported_stale or not self.measured

    def report(self, now: float) -> list[ProbeReport]:
        """Return the reports on changes to stale or back, limited in number.

        A recovery is delayed if otherwise no report would be left for the next failure.
        """
        if self.reason and self._reported_stale:
            return self._report_another_error(now)
        if bool(self.reason) == self._reported_stale:
            return []
        self._report_times = [t for t in self._report_times if now - t < REPORT_WINDOW]
        if not self.reason and len(self._report_times) >= REPORTS - 1:
            return []
        self._report_times.append(now)
        self._reported_at = now
        self._reported_stale, self._reported = bool(self.reason), self.reason
        reason = self.reason
        if reason and len(self._report_times) >= REPORTS - 1:
            reason += f"; it changes often, so it counts as stale for up to {REPORT_WINDOW:g} s"
        return [ProbeReport(self.name, self.names, self._reported_stale, reason)]

    def _report_another_error(self, now: float) -> list[ProbeReport]:
        if self.reason == self._reported or now - self._reported_at < ANOTHER_ERROR:
            return []
        self._reported, self._reported_at = self.reason, now
        return [ProbeReport(self.name, self.names, True, self.reason)]

    def close(self) -> None:
        """Close the probe, in the thread that reads it."""
        self.closed = self._guarded("close", methodcaller("close"), self._probe)[1] == ""

    def _read(self) -> None:
        started = self._clock()
        self._started = started
        values, reason = self._guarded("read", read_values, self._probe, self.names)
        by_process: UsageByProcess | None = None
        if values is not None:
            by_process, reason = self._guarded(
                "by_process", read_processes, self._probe, self._resources
            )
        devices, fault = self._guarded("devices", read_devices, self._probe)
        if by_process is None or values is None:
            values, by_process = (), EMPTY
        ended = self._clock()
        self.outcome = _Outcome(
            values,
            by_process,
            devices,
            reason or fault,
            ended - started,
            ended - self.asked,
            started,
        )
        self.busy = False
        if not self._progress.is_set():  # `set` takes as long as a quick read
            self._progress.set()

    def _guarded(
        self, name: str, call: Callable[..., _T], *arguments: Any
    ) -> tuple[_T | None, str]:
        """Return the result of a call of the probe, or None and why it failed."""
        ask = partial(call, *arguments)
        try:
            return guarded(ask, whom=self._title, hook=name, of=self._probe), ""
        except PluginError as fault:
            return None, f"{name}() raised {fault}" if fault.was_raised else str(fault)
