"""Fakes around probes, and what the slave relies on in one."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rosrm.extensions.contracts import Probe, ProbeContext, ProbeOffer
from rosrm.extensions.registry import MadeProbe
from rosrm.model.description_checks import resource_fault
from rosrm.model.values import EMPTY, Reading, ResourceDescription
from rosrm.slave.sampler import read_values
from rosrm.testing.calls import call, made


class FakeClock:
    """A clock that stands until it is told to go on.

    Attributes:
        now: monotonic seconds.
    """

    def __init__(self, now: float = 1000.0) -> None:
        self.now = now

    def __call__(self) -> float:
        """The time."""
        return self.now

    def advance(self, seconds: float) -> float:
        """Let time pass; returns the new time."""
        self.now += seconds
        return self.now


@dataclass
class FakeSessions:
    """Process trees as the test says; implements `rosrm.extensions.contracts.Sessions`."""

    members: tuple[int, ...] = ()
    ended: float = 0.0

    def pids(self) -> Sequence[int]:
        """The processes."""
        return self.members

    def ended_cpu_time(self) -> float:
        """Seconds of CPU of those that have ended."""
        return self.ended


class FakeProbe:
    """Answers as the test says.

    Attributes:
        answer: usage by resource, what the next reads return.
        fault: raised by the next reads; None: they answer.
        gate: reads wait for it; set it to let a hanging read go on.
        reads: how many were begun.
        closed: how often it was closed.
    """

    def __init__(self, **answer: float) -> None:
        self.answer: Mapping[str, Any] = answer
        self.fault: BaseException | None = None
        self.gate = threading.Event()
        self.gate.set()
        self.reads = 0
        self.closed = 0
        self._resources = tuple(ResourceDescription(name, "1", 1.0) for name in answer)

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Those that it was made with, each of capacity 1."""
        return self._resources

    def read(self) -> Iterable[Reading]:
        """The answer, when the gate is open."""
        self.reads += 1
        if not self.gate.wait(60.0):
            raise TimeoutError("the test left the gate shut")
        if self.fault is not None:
            raise self.fault
        return [Reading(name, usage) for name, usage in self.answer.items()]

    def close(self) -> None:
        """Count."""
        self.closed += 1


def made_probe(name: str, probe: Probe, *, period: float = 0.1, deadline: float = 1.0) -> MadeProbe:
    """A probe as the registry hands it to the slave."""
    return MadeProbe(name, probe, tuple(probe.resources), period, deadline)


def probe_context(
    scope: str = "machine",
    *,
    budget: Mapping[str, float] = EMPTY,
    data_directory: Path = Path("/"),
    sessions: FakeSessions | None = None,
) -> ProbeContext:
    """What a probe is given when it is made."""
    return ProbeContext(scope, budget, data_directory, sessions or FakeSessions())


class ProbeContract:
    """What the slave relies on in a probe.

    Attributes:
        offer: what is tested.
        options: by name, as host.yaml has them; the others have their defaults.
        context: what the probe is made with.
    """

    offer: ClassVar[ProbeOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY
    context: ClassVar[ProbeContext] = probe_context()

    def make(self) -> Probe:
        """A new probe; override it where more is needed."""
        probe: Probe = made("probe", self.offer, self.options, self.context)
        return probe

    def _read(self, probe: Probe) -> None:
        """Read as a slave does: within the deadline, and with its checks."""
        names = tuple(resource.name for resource in probe.resources)
        call("read", self.offer.deadline, lambda: read_values(probe, names))

    def test_resources_are_well_described(self) -> None:
        """Each by its type, names unique and declared by the offer, capacities above 0."""
        probe = self.make()
        resources = list(probe.resources)
        probe.close()
        names = [resource.name for resource in resources]
        assert resources, "a probe that reads nothing should raise SkipPlugin"
        for resource in resources:
            fault = resource_fault(resource)
            assert not fault, f"the probe {fault}"
        assert len(set(names)) == len(names), f"two resources of one name: {names}"
        assert set(names) <= set(self.offer.resources), (
            f"ProbeOffer.resources is {self.offer.resources}, and it reads {names}"
        )

    def test_reads_each_resource_once(self) -> None:
        """Every read brings one sane reading of each resource, and of nothing else."""
        probe = self.make()
        for _ in range(5):
            self._read(probe)
        probe.close()

    def test_resources_stay(self) -> None:
        """What is described does not change while the slave runs."""
        probe = self.make()
        before = list(probe.resources)
        self._read(probe)
        after = list(probe.resources)
        assert after == before, f"resources were {before}, and are {after} after a read"
        probe.close()

    def test_reads_in_another_thread(self) -> None:
        """A read in time works in a thread that did not make the probe, as the slave does it."""
        probe = self.make()
        answers: list[list[Reading]] = []
        thread = threading.Thread(target=lambda: answers.append(list(probe.read())), daemon=True)
        thread.start()
        thread.join(self.offer.deadline)
        assert answers, f"no answer within its own deadline of {self.offer.deadline:g} s"
        probe.close()

    def test_close_releases_files(self) -> None:
        """Made, read and closed once more, it holds no more files than before."""
        before = 0
        for turn in range(3):
            probe = self.make()
            self._read(probe)
            probe.close()
            if turn == 0:  # the first may load a library for good
                before = _open_files()
        more = _open_files() - before
        assert more <= 0, f"a probe that was made, read and closed leaves {more} more files open"

    def test_offer_is_complete(self) -> None:
        """It has a name, a line of summary, and periods above 0."""
        assert self.offer.name, "ProbeOffer.name is empty"
        assert self.offer.summary, "ProbeOffer.summary is empty; `rosrm plugins` shows it"
        assert self.offer.period > 0, f"ProbeOffer.period is {self.offer.period}; allowed: above 0"
        assert self.offer.deadline > 0, (
            f"ProbeOffer.deadline is {self.offer.deadline}; allowed: above 0"
        )


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a directory that changes by being read
