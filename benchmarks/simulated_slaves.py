"""Many slaves in one process, with the code of a real slave except for probes and processes.

Each simulated slave is a real `SlaveEndpoint` (handshake, registration, readings, requests for
work, statuses) over a real slave's core. Its readings come from a random walk instead of probes,
and each instance is reported as running, and then as ended if it is of a job, without a process.

All slaves of a process share one DDS participant, one node, and the entities that are seldom used:
the clients of the master's services, the publishers of statuses and usages, and the reader of
`master_beat`. Each has its own key, its own publisher of readings and its own service for orders,
which receives single assignments.

The process prints one JSON object when all are registered and accepted. A line on its standard
input begins a measurement and the next one ends it; then it prints the counts as JSON.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import select
import socket
import sys
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from typing import NoReturn

import numpy as np

from benchmarks.machine import say
from benchmarks.shared_participant import BerthEndpoints, SharedParticipant, Tally
from rosrm.core.slave import commands, reducer
from rosrm.core.slave.events import (
    AssignmentsReceived,
    Event,
    MasterLost,
    Registered,
    SupervisorReported,
    TimePassed,
)
from rosrm.core.slave.state import SlaveState, under_limits
from rosrm.errors import Refused, RosrmError
from rosrm.keys.finding import host_security
from rosrm.keys.roles import SecurityMode
from rosrm.keys.security import Member
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Assignment,
    HostDescription,
    InstanceState,
    InstanceStatus,
    Kind,
    ResourceDescription,
)
from rosrm.ros.slave.endpoint import MasterLink, SlaveEndpoint
from rosrm.ros.slave.services import Duties, SlaveServices
from rosrm.testing.loopback import settings_on_this_machine

#: Most seconds between two looks at standard input.
_LOOK = 0.05
#: Slaves that register at a time. More would only wait, because DDS at the master compares each new
#: endpoint with all others.
_AT_ONCE = 20
#: Seconds between two rounds of cycles. Slaves that are due in that time are served together,
#: because each poll for messages costs at least 25 us.
_ROUND = 0.005
#: Most turns of reception between two rounds; number of turns without a callback after which the
#: queues are empty.
_TURNS = 1000
_IDLE_TURNS = 3
#: Seconds between two cycles of a slave during start-up, which occupies the machine.
_GENTLY = 0.25
_LIMIT = 0.8
#: Standard deviation of a usage's change from one cycle to the next: it causes as many messages as
#: a real slave that measures a busy machine.
STEP = 0.005
#: Bounds of the usages, below the limit.
_BETWEEN = (0.05, 0.7)
_RESOURCES = (("memory", "B", 2.0**34), ("cpu", "core", 16.0), ("disk", "B", 2.0**40))
_PRESENT = (1 << len(_RESOURCES)) - 1


class Walks:
    """The readings of many slaves: a random walk of each usage between two bounds.

    Args:
        slaves: how many.
        step: standard deviation of a usage's change in one cycle, fraction.
    """

    def __init__(self, slaves: int, step: float) -> None:
        self._random = np.random.default_rng(slaves)
        self._step = step
        self._used = self._random.uniform(*_BETWEEN, (slaves, len(_RESOURCES)))
        self._usage = np.zeros((slaves, RESOURCE_SLOTS), np.float32)
        self.limit = array("f", len(_RESOURCES) * [_LIMIT])
        self.limit.extend((RESOURCE_SLOTS - len(_RESOURCES)) * [1.0])
        self.go_on()

    def go_on(self) -> None:
        """Advance all readings by one cycle."""
        self._used += self._random.normal(0.0, self._step, self._used.shape)
        np.clip(self._used, *_BETWEEN, out=self._used)
        self._usage[:, : len(_RESOURCES)] = self._used

    def usage_of(self, slave: int) -> array[float]:
        """Return the newest usages of a slave, by slot."""
        return array("f", self._usage[slave].tobytes())


class SimulatedSlave:
    """A slave with simulated readings and processes; `joined` is called after its registration."""

    def __init__(
        self, endpoints: BerthEndpoints, name: str, period: float, tally: Tally,
        joined: Callable[[], None],
    ) -> None:  # fmt: skip
        self.name = name
        self._tally = tally
        self._joined = joined
        self._state = SlaveState()
        self._events: list[Event] = []
        resources = tuple(ResourceDescription(*one) for one in _RESOURCES)
        description = HostDescription(
            name, int.from_bytes(os.urandom(7), "big") | 1, hostname=socket.gethostname(),
            pid=os.getpid(), labels={"host": name}, resources=resources, period=period,
        )  # fmt: skip
        self.endpoint = SlaveEndpoint(endpoints, description, self._state, take=self.take)
        duties = Duties(self.take, *[self._refuse] * (len(fields(Duties)) - 1))
        self._services = SlaveServices(endpoints, duties, name, 5.0, self.endpoint)

    @property
    def registered(self) -> bool:
        """Return True if the master has accepted its registration."""
        return self.endpoint.link is MasterLink.REGISTERED

    def cycle(self, usage: array[float], limit: array[float], now: float) -> None:
        """Do a slave's work of one period of `resource_info`."""
        self.endpoint.advance(now)
        accepting = under_limits(usage, limit, _PRESENT, 0)
        self.endpoint.publish_reading(
            usage, limit, _PRESENT, 0, accepting=accepting, processes=self._state.live()
        )
        self._events.append(TimePassed())
        self.work(now)

    def work(self, now: float) -> None:
        """Process the queued events; report launched processes as running, jobs also as ended."""
        while self._events:
            events, self._events = self._events, []
            for command in reducer.step_all(self._state, events, now):
                if isinstance(command, commands.Report):
                    self.endpoint.publish_statuses(command.statuses, complete=command.complete)
                elif isinstance(command, commands.Launch):
                    self._run(command.assignments)
        self._services.acknowledge_starts()
        self.endpoint.ask(now)

    def _run(self, assignments: Sequence[Assignment]) -> None:
        for one in assignments:
            self._tally.taken[one.instance.process] = time.time()
            is_job = one.spec.kind is Kind.JOB
            last = InstanceState.EXITED if is_job else InstanceState.READY
            for state in (InstanceState.RUNNING, last):
                status = InstanceStatus(one.instance, state, pid=os.getpid())
                self._events.append(SupervisorReported((status,)))

    def take(self, event: Event) -> None:
        """Queue an event; process assignments at once, as a slave's loop does."""
        self._events.append(event)
        self._tally.lost += isinstance(event, MasterLost)
        if isinstance(event, Registered):
            self._joined()
        if isinstance(event, AssignmentsReceived):
            self.work(time.monotonic())

    def _refuse(self, *_request: object) -> NoReturn:
        raise Refused(f"{self.name} is simulated: it has no processes", "unknown")


class Fleet:
    """The slaves of this process, each with its own schedule.

    Args:
        settings: the domain.
        first: number of the first slave.
        count: how many.
        period: seconds between two cycles of a slave.
        step: of a usage in one cycle, as in `Walks`.
        security: of the master.
    """

    def __init__(
        self, settings: RosSettings, first: int, count: int, period: float, step: float,
        security: SecurityMode,
    ) -> None:  # fmt: skip
        self.tally = Tally()
        self.slaves: list[SimulatedSlave] = []
        self._first = first
        self._count = count
        self._period = period
        self._security = security
        self._pace = max(period, _GENTLY)
        self._walks = Walks(count, step)
        self._shared = SharedParticipant(settings, f"rosrm_simulated_{first}", self.tally)
        self._due: list[tuple[float, int]] = []
        self._joined: list[int] = []

    def bring_up(self, timeout: float) -> None:
        """Make and register all slaves, a few at a time.

        Raises:
            TimeoutError: not all were registered in time.
            RosrmError: the master refused one.
        """
        deadline = time.monotonic() + timeout
        while len(self.slaves) < self._count:
            self._make_some()
            while not all(slave.registered for slave in self.slaves):
                self.go_on(_LOOK)
                for slave in self.slaves:
                    if slave.endpoint.failure:
                        raise RosrmError(slave.endpoint.failure)
                if time.monotonic() >= deadline:
                    there = sum(slave.registered for slave in self.slaves)
                    raise TimeoutError(f"{there} of {self._count} registered in {timeout:g} s")
        self._pace = self._period

    def _make_some(self) -> None:
        now = time.monotonic()
        for index in range(len(self.slaves), min(len(self.slaves) + _AT_ONCE, self._count)):
            name = f"sim{self._first + index:05d}"
            endpoints = BerthEndpoints(self._shared, _security(self._security, name))
            joined = partial(self._joined.append, index)
            slave = SimulatedSlave(endpoints, name, self._period, self.tally, joined)
            self.slaves.append(slave)
            # Spread over the period, as the cycles of separate slaves are.
            heapq.heappush(self._due, (now + self._period * index / self._count, index))

    def go_on(self, seconds: float) -> None:
        """Serve due cycles and messages for so many seconds."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            while self._due and self._due[0][0] <= now:
                self._cycle(now)
            self._drain()
            wake = max(now + _ROUND, self._due[0][0]) if self._due else end
            while (left := min(end, wake) - time.monotonic()) > 0.0:
                self._shared.participant.spin(left)
                while self._joined:  # a real slave sends its first reading at once, too
                    self._work_for(self._joined.pop(), time.monotonic())

    def _drain(self) -> None:
        """Process the received messages, also when the next cycles are due already.

        Each turn takes at least one event. Answers to slaves of another process are events as well,
        but call no callback, so that only several such turns in a row show that the queues are
        empty.
        """
        idle = 0
        for _ in range(_TURNS):
            idle = 0 if self._shared.participant.spin(0.0) else idle + 1
            if idle == _IDLE_TURNS:
                break

    def _cycle(self, now: float) -> None:
        due, index = self._due[0]
        if now - due > self._pace:
            self.tally.late += 1
            due = now
        heapq.heapreplace(self._due, (due + self._pace, index))
        if index == 0:  # its next cycle comes after one of each other slave
            self._walks.go_on()
        self._work_for(index, now)

    def _work_for(self, index: int, now: float) -> None:
        slave = self.slaves[index]
        slave.cycle(self._walks.usage_of(index), self._walks.limit, now)
        self.tally.cycles += slave.registered

    def close(self) -> None:
        """Leave the ROS graph."""
        self._shared.participant.close()


def _security(mode: SecurityMode, name: str) -> Member:
    """Return the security of a slave, which finds its key as a real one does."""
    found = host_security(mode, name)
    if found is None:
        raise RosrmError(f"host:{name} has no key: ROSRM_KEYS names no directory of a master")
    return found


def _told_to_go_on(fleet: Fleet) -> bool:
    """Serve the slaves until a line comes on standard input; False: it was closed."""
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        fleet.go_on(_LOOK)
    return bool(sys.stdin.readline())


def main() -> int:
    """Simulate the slaves until standard input is closed; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--slaves", type=int, required=True)
    parser.add_argument("--hz", type=float, required=True)
    parser.add_argument("--step", type=float, default=STEP)
    parser.add_argument("--timeout", type=float, default=120.0)
    parser.add_argument("--security", choices=["keys", "none"], default="keys")
    arguments = parser.parse_args()
    settings = settings_on_this_machine(arguments.domain)
    period = 1.0 / arguments.hz
    fleet = Fleet(
        settings, arguments.first, arguments.slaves, period, arguments.step, arguments.security
    )
    try:
        fleet.bring_up(arguments.timeout)
    except (RosrmError, TimeoutError) as error:
        say(f"simulated slaves {arguments.first} and on: {error}")
        return 2
    print(json.dumps({"registered": len(fleet.slaves)}), flush=True)
    while _told_to_go_on(fleet):
        fleet.tally.begin()
        used = resource.getrusage(resource.RUSAGE_SELF)
        began, cpu = time.monotonic(), used.ru_utime + used.ru_stime
        goes_on = _told_to_go_on(fleet)
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(
            json.dumps(
                {
                    "seconds": time.monotonic() - began, "cycles": fleet.tally.cycles,
                    "messages": fleet.tally.messages, "late": fleet.tally.late,
                    "lost": fleet.tally.lost,
                    "cpu": used.ru_utime + used.ru_stime - cpu,
                    "taken": fleet.tally.taken,
                }
            ),
            flush=True,
        )  # fmt: skip
        if not goes_on:
            break
    fleet.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
