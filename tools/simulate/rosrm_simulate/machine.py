"""The model of one host: the slave's core, and the programs on the host.

A host has CPU time to share: while its processes want more cores than there are, each gets the same
part of its demand, and one with work to do takes so much longer. Memory is the sum over the
processes; there is no out-of-memory kill, so that overload shows in the limits alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

import numpy as np

from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.slave.state import SlaveState, under_limits
from rosrm.model.values import (
    RESOURCE_SLOTS,
    Assignment,
    HostDescription,
    InstanceId,
    InstanceState,
    InstanceStatus,
    RestartPolicy,
)
from rosrm_simulate.workload import HostPlan, ProcessPlan

#: Seconds of work left that count as none, because sums of fractions are not exact.
_NONE_LEFT = 1e-9


@dataclass(slots=True)
class Program:
    """One instance on a host.

    Attributes:
        begun: time at which it began to run; None: it is starting.
        work: seconds of its duration that it has done.
        stopping: it was ordered to end.
        run: counts its starts: plans for an earlier one are void.
    """

    plan: ProcessPlan
    assignment: Assignment
    restart: RestartPolicy
    begun: float | None = None
    work: float = 0.0
    stopping: bool = False
    run: int = 0
    peak: float = 0.0


class Reading(NamedTuple):
    """A slave's reading; `usage` (RESOURCE_SLOTS,), fractions; `accepts`: under all limits."""

    at: float
    usage: FloatArray
    accepts: bool


@dataclass(slots=True)
class Machine:
    """One host of a simulation.

    Attributes:
        incarnation: of its slave.
        host_id: assigned by the master; 0: it is not registered.
        up: it runs; a host that is down neither receives nor sends anything.
        stopping: its slave is shutting down, and the host goes with its last process.
        asked: it has asked for work.
        limit: (RESOURCE_SLOTS,) as in its readings.
    """

    plan: HostPlan
    incarnation: int
    period: float
    slave: SlaveState = field(default_factory=SlaveState)
    programs: dict[InstanceId, Program] = field(default_factory=dict)
    host_id: int = 0
    up: bool = True
    stopping: bool = False
    asked: bool = False
    sequence: int = 0
    batches: int = 0
    told_usage: tuple[tuple[int, float, float], ...] = ()
    limit: FloatArray = field(init=False)
    _worked_until: float = 0.0
    _rate: float = 1.0
    _level_from: float = 0.0
    _reading: Reading | None = None

    def __post_init__(self) -> None:
        self.slave.max_processes = self.plan.max_processes
        names = [one.name for one in self.plan.resources]
        self.limit = np.ones(RESOURCE_SLOTS)
        self.limit[: len(names)] = [self.plan.limits.get(name, 1.0) for name in names]

    def description(self) -> HostDescription:
        """Return the description with which its slave registers."""
        plan = self.plan
        return HostDescription(
            plan.name, self.incarnation, labels=plan.labels, resources=plan.resources,
            max_processes=plan.max_processes, period=self.period,
        )  # fmt: skip

    # --- programs --------------------------------------------------------------------------

    def begin(self, instance: InstanceId, now: float) -> None:
        """Let a starting instance run from now on."""
        program = self.programs[instance]
        if program.begun is None:
            program.begun = now
        self.changed(now)

    def remove(self, instance: InstanceId, now: float) -> Program:
        """Remove an instance that has ended; return its program."""
        self.changed(now)
        program = self.programs.pop(instance)
        self.changed(now)
        return program

    def changed(self, now: float) -> None:
        """Apply a change of the programs: past work at the old CPU rate, further at the new."""
        self._work_until(now)
        wanted = sum(one.plan.cpu for one in self.programs.values() if one.begun is not None)
        cores = self.plan.capacity("cpu") * (1.0 - self.plan.busy.get("cpu", 0.0))
        self._rate = 1.0 if wanted <= cores or not self.plan.capacity("cpu") else cores / wanted
        running = [one for one in self.programs.values() if one.begun is not None]
        self._level_from = max((_level_from(one) for one in running), default=0.0)
        self._reading = None

    def _work_until(self, now: float) -> None:
        for program in self.programs.values():
            if program.begun is not None:
                since = max(self._worked_until, program.begun)
                program.work += max(0.0, now - since) * self._rate_of(program)
                program.peak = max(program.peak, self.memory_of(program, now))
        self._worked_until = now

    def _rate_of(self, program: Program) -> float:
        return self._rate if program.plan.cpu > 0.0 else 1.0

    def next_end(self) -> float:
        """Return the time of the next end of work at the present rate; inf: there is none."""
        return min(
            (self._end_of(one) for one in self.programs.values() if one.begun is not None),
            default=inf,
        )

    def _end_of(self, program: Program) -> float:
        rate = self._rate_of(program)
        if program.plan.duration == inf or program.stopping or rate <= 0.0:
            return inf
        return self._worked_until + max(0.0, program.plan.duration - program.work) / rate

    def done(self, now: float) -> list[InstanceId]:
        """Return the instances whose work is done."""
        self._work_until(now)
        return [
            instance
            for instance, one in self.programs.items()
            if one.begun is not None and not one.stopping
            and one.work >= one.plan.duration - _NONE_LEFT
        ]  # fmt: skip

    # --- readings and usages ---------------------------------------------------------------

    def memory_of(self, program: Program, now: float) -> float:
        """Return the bytes that an instance holds."""
        return 0.0 if program.begun is None else program.plan.memory.at(now - program.begun)

    def cpu_of(self, program: Program) -> float:
        """Return the cores that an instance gets."""
        return 0.0 if program.begun is None else program.plan.cpu * self._rate

    def grows(self, now: float) -> bool:
        """Return True if the memory of a process is still changing."""
        return now < self._level_from

    def reading(self, now: float) -> Reading:
        """Return the slave's reading for `resource_info`."""
        if self._reading is None or self.grows(self._reading.at):
            used = self.usage(now)
            usage = np.zeros(RESOURCE_SLOTS)
            usage[: len(used)] = [used[one.name] for one in self.plan.resources]
            present = (1 << len(used)) - 1
            accepts = under_limits(
                usage.astype(np.float32), self.limit.astype(np.float32), present, 0
            )
            self._reading = Reading(now, usage, accepts)
        return self._reading

    def usage(self, now: float) -> Mapping[str, float]:
        """Return the fraction of each resource that is used."""
        held = sum(self.memory_of(one, now) for one in self.programs.values())
        used = {"memory": held}
        running = [one for one in self.programs.values() if one.begun is not None]
        used["cpu"] = sum(self.cpu_of(one) for one in running)
        used["disk"] = sum(one.plan.disk for one in running)
        return {
            one.name: self.plan.busy.get(one.name, 0.0) + used.get(one.name, 0.0) / one.capacity
            for one in self.plan.resources
        }

    def usages(self, now: float) -> tuple[tuple[int, float, float], ...]:
        """Return number, cores and bytes of each instance."""
        return tuple(
            (instance.number, self.cpu_of(one), self.memory_of(one, now))
            for instance, one in self.programs.items()
        )

    def end_status(
        self, instance: InstanceId, program: Program, now: float, *, signal: int = 0
    ) -> InstanceStatus:
        """Return the supervisor's status for an instance that has ended."""
        run_time = 0.0 if program.begun is None else now - program.begun
        cpu_time = program.plan.cpu * program.work
        return InstanceStatus(
            instance, InstanceState.EXITED, exit_signal=signal, run_time=run_time,
            peak_memory=max(program.peak, self.memory_of(program, now)), cpu_time=cpu_time,
        )  # fmt: skip


def _level_from(program: Program) -> float:
    """Return the time from which the memory of an instance stays constant."""
    assert program.begun is not None
    return program.begun + program.plan.memory.level_from
