"""Input of a simulation: hosts with their times, arriving processes, and the model of a host.

Seconds, bytes, cores and fractions are the units; times count from the beginning of the run.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf

from rosrm.core.master.events import Event
from rosrm.model.devices import Device
from rosrm.model.values import EMPTY, ProcessSpec, ResourceDescription


@dataclass(frozen=True, slots=True)
class Model:
    """The model of every host; docs/reference/simulation.md lists its simplifications.

    Attributes:
        period: seconds between two readings.
        usage_period: seconds between two messages with the usage of each process.
        start: seconds from the order to start a process until it runs and holds its memory.
        ready: seconds from there until a ROS node is seen in the graph.
        stop: seconds from the order to stop a process until it has ended.
        wire: seconds that a message takes one way.
        handoff: seconds that a destination takes to follow the state of its source.
    """

    period: float = 0.1
    usage_period: float = 1.0
    start: float = 0.3
    ready: float = 0.7
    stop: float = 0.1
    wire: float = 0.002
    handoff: float = 0.5


@dataclass(frozen=True, slots=True)
class SimulatedLink:
    """The only network interface of a host, which all its links to other hosts share.

    Attributes:
        rate: bytes a second that it can carry.
        round_trip: seconds from the host to the middle of the network and back.
        limit: fraction of the rate that flows may use.
    """

    rate: float
    round_trip: float = 0.0
    limit: float = 1.0


@dataclass(frozen=True, slots=True)
class SimulatedHost:
    """One host.

    Attributes:
        resources: with their capacities.
        limits: upper limits, fractions by resource.
        busy: usage by other programs, fractions by resource, all the time.
        devices: devices of the host.
        joins: time at which its slave registers.
        leaves: time at which it goes; inf: never.
        lost: it goes without a message, and its processes end with it; else its slave shuts down.
        link: to the other hosts; None: not known.
    """

    name: str
    resources: tuple[ResourceDescription, ...]
    limits: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    max_processes: int = 0
    busy: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    joins: float = 0.0
    leaves: float = inf
    lost: bool = False
    link: SimulatedLink | None = None
    devices: tuple[Device, ...] = ()

    def capacity(self, resource: str) -> float:
        """Return the capacity in base units; 0 where it has no such resource."""
        return next((one.capacity for one in self.resources if one.name == resource), 0.0)

    def room(self, resource: str) -> float:
        """Return the base units up to the limit, for an empty host."""
        return self.capacity(resource) * self.limits.get(resource, 1.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """An amount over the age of a process: straight lines between points, constant after the last.

    Attributes:
        ages: seconds, rising from 0.
        amounts: base units.
    """

    ages: tuple[float, ...]
    amounts: tuple[float, ...]

    @classmethod
    def growing(cls, first: float, rate: float, most: float) -> Curve:
        """Return a curve from `first` by `rate` a second up to `most`; a rate of 0 is constant."""
        if rate <= 0.0:
            return cls((0.0,), (first,))
        if most == inf:
            return cls((0.0, inf), (first, rate))
        return cls((0.0, max(most - first, 0.0) / rate), (first, max(most, first)))

    @property
    def level_from(self) -> float:
        """Return the age from which the amount is constant."""
        return self.ages[-1]

    @property
    def most(self) -> float:
        """Return the largest amount; inf: it grows without end."""
        return inf if self.level_from == inf else max(self.amounts)

    def at(self, age: float) -> float:
        """Return the amount at an age."""
        if age >= self.ages[-1]:
            return self.amounts[-1]
        if self.ages[-1] == inf:
            return self.amounts[0] + self.amounts[1] * max(age, 0.0)
        right = bisect_right(self.ages, age)
        if right == 0:
            return self.amounts[0]
        before, after = self.ages[right - 1], self.ages[right]
        part = (age - before) / (after - before)
        return self.amounts[right - 1] + part * (self.amounts[right] - self.amounts[right - 1])


@dataclass(frozen=True, slots=True)
class ProcessPlan:
    """One process: its submission, and its real behaviour.

    Attributes:
        spec: as it is submitted.
        arrives: time of its submission.
        memory: bytes, by its age.
        cpu: cores that it wants.
        disk: bytes that it holds on disk.
        duration: seconds that it runs with all the CPU that it wants; inf: it never ends.
    """

    spec: ProcessSpec
    arrives: float
    memory: Curve
    cpu: float = 0.0
    disk: float = 0.0
    duration: float = inf

    @property
    def name(self) -> str:
        """Return its name."""
        return self.spec.name


@dataclass(frozen=True, slots=True)
class Workload:
    """The whole input of a simulation.

    Attributes:
        requests: of users: cancel, restart, migrate, drain …, with their times.
        until: the run ends here at the latest; inf: when nothing can change any more.
    """

    name: str
    hosts: tuple[SimulatedHost, ...]
    processes: tuple[ProcessPlan, ...]
    model: Model = Model()
    requests: tuple[tuple[float, Event], ...] = ()
    until: float = inf

    def with_hosts(self, count: int) -> Workload:
        """Return a copy with so many hosts: the first ones, or copies of them all by turns."""
        hosts = [_copy(self.hosts, number) for number in range(count)]
        return replace(self, hosts=tuple(hosts))


def _copy(hosts: Sequence[SimulatedHost], number: int) -> SimulatedHost:
    turn, index = divmod(number, len(hosts))
    host = hosts[index]
    if not turn:
        return host
    taken = {one.name for one in hosts}
    name = f"{host.name}.{turn}"
    while name in taken:
        name += "."
    return replace(host, name=name)
