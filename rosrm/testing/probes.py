"""Fakes for probes, and the contract of probes with the slave."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rosrm import threads
from rosrm.errors import PluginError, describe_plugin_fault
from rosrm.extensions.contracts import HostLabelling, Probe, ProbeContext, ProbeOffer
from rosrm.extensions.made import MadeProbe, fault_of_labels, unmeasured
from rosrm.extensions.plugin_calls import implements, with_place
from rosrm.model.description_checks import resource_fault
from rosrm.model.values import EMPTY, Reading, ResourceDescription
from rosrm.slave.probe_reads import read_devices, read_processes, read_values
from rosrm.testing.calls import call, made


class FakeClock:
    """Clock that advances only by `advance`.

    Attributes:
        now: monotonic seconds.
    """

    def __init__(self, now: float = 1000.0) -> None:
        self.now = now

    def __call__(self) -> float:
        """Return the time."""
        return self.now

    def advance(self, seconds: float) -> float:
        """Advance the clock; return the new time."""
        self.now += seconds
        return self.now


@dataclass
class FakeSessions:
    """Fake process trees; an implementation of `rosrm.extensions.contracts.Sessions`."""

    members: tuple[int, ...] = ()
    ended: float = 0.0

    def pids(self) -> Sequence[int]:
        """Return the pids of the processes."""
        return self.members

    def ended_cpu_time(self) -> float:
        """Return the CPU seconds of ended processes."""
        return self.ended


class FakeProbe:
    """Probe with answers set by the test.

    Attributes:
        answer: usage by resource, returned by the next reads.
        fault: raised by the next reads; None: the reads return.
        gate: reads wait for this event; set it to continue a hanging read.
        reads: number of reads begun.
        closed: number of calls of `close`.
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
        """Return the resources given at construction, each of capacity 1."""
        return self._resources

    def read(self) -> Iterable[Reading]:
        """Return the answer when the gate is open."""
        self.reads += 1
        if not self.gate.wait(60.0):
            raise TimeoutError("the test left the gate shut")
        if self.fault is not None:
            raise self.fault
        return [Reading(name, usage) for name, usage in self.answer.items()]

    def close(self) -> None:
        """Count the call."""
        self.closed += 1


def made_probe(name: str, probe: Probe, *, period: float = 0.1, deadline: float = 1.0) -> MadeProbe:
    """Return a probe as the registry passes it to the slave."""
    return MadeProbe(name, probe, tuple(probe.resources), period, deadline)


def probe_context(
    scope: str = "machine",
    *,
    budget: Mapping[str, float] = EMPTY,
    data_directory: Path = Path("/"),
    sessions: FakeSessions | None = None,
) -> ProbeContext:
    """Return the context with which a probe is created."""
    return ProbeContext(scope, budget, data_directory, sessions or FakeSessions())


class ProbeContract:
    """Contract of a probe with the slave.

    Attributes:
        offer: the tested offer.
        options: by name, as in host.yaml; the others have their defaults.
        context: with which the probe is created.
    """

    offer: ClassVar[ProbeOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY
    context: ClassVar[ProbeContext] = probe_context()

    def make(self) -> Probe:
        """Return a new probe; override this if the probe needs more."""
        probe: Probe = made("probe", self.offer, self.options, self.context)
        return probe

    def _read(self, probe: Probe) -> None:
        """Read the probe as a slave does, within the deadline and with its checks."""
        names = tuple(resource.name for resource in probe.resources)
        call("read", self.offer.deadline, lambda: read_values(probe, names), probe)
        resources = tuple(probe.resources)
        call("by_process", self.offer.deadline, lambda: read_processes(probe, resources), probe)

    def test_resources_are_well_described(self) -> None:
        """Resources have valid types, unique names of the offer, and capacities above 0."""
        probe = self.make()
        resources = list(probe.resources)
        probe.close()
        names = [resource.name for resource in resources]
        assert resources, "a probe that reads nothing should raise SkipPlugin"
        for resource in resources:
            fault = resource_fault(resource)
            assert not fault, f"the probe {fault}"
        fault = unmeasured(resources, measures=hasattr(probe, "by_process"))
        assert not fault, f"the probe {fault}"
        assert len(set(names)) == len(names), f"two resources of one name: {names}"
        assert set(names) <= set(self.offer.resources), (
            f"ProbeOffer.resources is {self.offer.resources}, and it reads {names}"
        )

    def test_labels_are_text(self) -> None:
        """Labels, if the probe has any, map printable text to printable text, and do not change."""
        probe: object = self.make()
        if not implements(probe, HostLabelling):
            return
        labels = probe.labels
        fault = fault_of_labels(labels, ())
        assert not fault, f"the probe {fault}"
        assert probe.labels == labels, f"labels were {labels}, and are {probe.labels}"

    def test_reads_each_resource_once(self) -> None:
        """Every read returns one valid reading of each resource, and no other reading."""
        probe = self.make()
        for _ in range(5):
            self._read(probe)
        probe.close()

    def test_devices_are_well_described(self) -> None:
        """Devices, if the probe finds any, are valid; no unit comes or goes."""
        probe = self.make()
        units = []
        for _ in range(3):
            self._read(probe)
            units.append([(one.kind, one.unit) for one in read_devices(probe)])
        assert units[0] == units[1] == units[2], f"the units were {units}; use `missing` instead"
        probe.close()

    def test_resources_stay(self) -> None:
        """The described resources do not change after a read."""
        probe = self.make()
        before = list(probe.resources)
        self._read(probe)
        after = list(probe.resources)
        assert after == before, f"resources were {before}, and are {after} after a read"
        probe.close()

    def test_reads_in_another_thread(self) -> None:
        """A read works within its deadline in a thread that did not create the probe."""
        probe = self.make()
        names = tuple(resource.name for resource in probe.resources)
        faults: list[str] = []

        def read() -> None:
            try:
                read_values(probe, names)
            except PluginError as wrong:
                faults.append(with_place(wrong, probe, "read"))
            except BaseException as fault:  # noqa: BLE001 - raised in the test by its text
                faults.append(describe_plugin_fault(fault))
            else:
                faults.append("")

        threads.start(read, "probe").join(self.offer.deadline)
        assert faults, f"no answer within its own deadline of {self.offer.deadline:g} s"
        assert not faults[0], f"read fails in another thread: {faults[0]}"
        probe.close()

    def test_close_releases_files(self) -> None:
        """A probe that is created, read and closed leaves no additional file open."""
        before = 0
        for turn in range(3):
            probe = self.make()
            self._read(probe)
            probe.close()
            if turn == 0:  # the first may load a library
                before = _open_files()
        more = _open_files() - before
        assert more <= 0, f"a probe that was made, read and closed leaves {more} more files open"

    def test_offer_is_complete(self) -> None:
        """The offer has a name, a summary of one line, and a period and deadline above 0."""
        assert self.offer.name, "ProbeOffer.name is empty"
        assert self.offer.summary, "ProbeOffer.summary is empty; `rosrm plugins` shows it"
        assert self.offer.period > 0, f"ProbeOffer.period is {self.offer.period}; allowed: above 0"
        assert self.offer.deadline > 0, (
            f"ProbeOffer.deadline is {self.offer.deadline}; allowed: above 0"
        )


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - reading the directory changes it
