"""Engine of a simulation: the master's core and the slaves' cores on virtual time.

The master's core gets the same events as in reality, with real policies, strategies and settings.
Its commands reach the hosts after the time that a message takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Any, Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import (
    Assign,
    Command,
    PublishStateConfig,
    Redeliver,
    Reply,
    SendOrder,
    Withdraw,
)
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.reducer import step
from rosrm.core.master.scheduling.ranking import NamedPolicy
from rosrm.core.master.settings import CoreSettings
from rosrm.core.slave.events import AssignmentsReceived, MasterHears, Registered, TimePassed
from rosrm.extensions.contracts import Intent, MigrationStrategy, Record
from rosrm.extensions.declared_fields import Declared
from rosrm.model.orders import seconds_of
from rosrm.model.values import EMPTY, InstanceId
from rosrm_simulate.agenda import Agenda
from rosrm_simulate.hosting import Hosting
from rosrm_simulate.machine import Machine
from rosrm_simulate.meter import Meter, Outcome
from rosrm_simulate.nodes import Nodes
from rosrm_simulate.workload import HostPlan, Workload

#: Events between two calls of `progress`.
_TELL_EVERY: Final = 2000


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a run.

    Attributes:
        now: virtual seconds.
        ended: processes that have ended.
    """

    now: float
    ended: int
    processes: int
    events: int


class Simulation:
    """One run of a workload.

    Args:
        workload: to be run; its first arrival must not be after its end.
        settings: of the master's core.
        policy: that orders the hosts, with its name.
        strategies: by name.
        declared: declarations of their offers. A simulated host has all executors.
    """

    def __init__(
        self,
        workload: Workload,
        settings: CoreSettings,
        policy: NamedPolicy,
        strategies: Mapping[str, MigrationStrategy],
        declared: Declared | None = None,
    ) -> None:
        self.workload = workload
        self.meter = Meter(workload.until)
        self.agenda = Agenda()
        self.state = MasterState(
            settings, policy[0], policy[1], strategies, epoch=1,
            declared=replace(declared or Declared(), executors=EMPTY),
        )  # fmt: skip
        self.machines: dict[str, Machine] = {}
        plans = {plan.name: plan for plan in workload.processes}
        self._hosting = Hosting(self.agenda, workload.model, plans, self._tell)
        self._nodes = Nodes(self.agenda, workload.model, self._hosting, self._tell)
        self._by_id: dict[int, Machine] = {}
        self._undelivered: set[InstanceId] = set()
        self._requests = 0
        self._taken_in: Reply | None = None
        self._active = 0.0
        self._usage_told = -1
        # After this long without any event, the passing of time alone has no further effect.
        self._patience = 2.0 + max(
            settings.settle, settings.hysteresis, settings.cooldown, settings.delivery_timeout,
            settings.lease, settings.order_retry,
        )  # fmt: skip

    def run(self, progress: Callable[[Progress], None] | None = None) -> Outcome:
        """Run until nothing can change any more, or until the workload's `until`."""
        self._plan()
        next_tick, told = 0.0, 0
        until = self.workload.until
        while True:
            now = min(self.agenda.next_time, next_tick)
            if now > until or (now == inf):
                self.agenda.now = until if until < inf else self.agenda.now
                break
            if self.agenda.next_time <= next_tick:
                self._active = now
                self.agenda.do_next()
            else:
                self.agenda.now = now
                self._tick()
                next_tick = self._after_tick(now)
            if progress is not None and self.meter.events - told >= _TELL_EVERY:
                told = self.meter.events
                progress(self._progress())
        return self.meter.outcome(self.state, self.agenda.now)

    def _after_tick(self, now: float) -> float:
        """Return the time of the next readings; they are left out while nothing changes."""
        if now - self._active <= self._patience:
            return now + self.workload.model.period
        return self.agenda.next_time if self.agenda.pending else inf

    def _progress(self) -> Progress:
        processes = len(self.workload.processes)
        return Progress(self.agenda.now, self.meter.ended, processes, self.meter.events)

    # --- what is planned -----------------------------------------------------------------

    def _plan(self) -> None:
        for host in self.workload.hosts:
            self.agenda.at(host.joins, partial(self._join, host))
            if host.leaves < inf:
                self.agenda.at(host.leaves, partial(self._leave, host))
        together: dict[float, list[str]] = {}
        specs = {plan.name: plan.spec for plan in self.workload.processes}
        for plan in self.workload.processes:
            together.setdefault(plan.arrives, []).append(plan.name)
        for time, names in together.items():
            submitted = happened.SubmissionReceived(0, tuple(specs[name] for name in names))
            self.agenda.at(time, partial(self._ask, submitted))
        for time, event in self.workload.requests:
            self.agenda.at(time, partial(self._ask, event))

    def _ask(self, request: Any) -> None:
        """Send a user's request to the master: an event with a request number."""
        self._requests += 1
        self._tell(replace(request, request=self._requests))

    def _join(self, plan: HostPlan) -> None:
        incarnation = len(self.machines) + 1
        machine = Machine(plan, incarnation, self.workload.model.period)
        self.machines[plan.name] = machine
        self._taken_in = None
        self._ask(happened.HostRegistered(0, machine.description()))
        reply: Reply | None = self._taken_in
        assert reply is not None  # _tell has set it
        machine.host_id = reply.host_id
        self._by_id[machine.host_id] = machine
        self._hosting.hear(machine, Registered(self.state.epoch))
        self._hosting.hear(machine, MasterHears(inf))  # no simulated host is cut off
        self._read([machine])

    def _leave(self, plan: HostPlan) -> None:
        machine = self.machines[plan.name]
        if plan.lost:
            self._hosting.lose(machine)
            return
        self._ask(happened.HostLeft(0, machine.host_id, machine.incarnation))
        self._hosting.stop_all(machine)

    # --- time ----------------------------------------------------------------------------

    def _tick(self) -> None:
        now = self.agenda.now
        there = [machine for machine in self.machines.values() if machine.up and machine.host_id]
        if any(machine.grows(now) for machine in there):
            self._active = now
            self.meter.changed(now)
        if there:
            self._read(there)
        turn = int(now / self.workload.model.usage_period)
        if turn != self._usage_told:
            self._usage_told = turn
            for machine in there:
                self._tell_usages(machine)
                self._hosting.hear(machine, TimePassed())
        self._tell(happened.TimePassed())

    def _read(self, machines: list[Machine]) -> None:
        """Deliver readings of hosts to the master; hosts under their limits ask for work."""
        readings = [machine.reading(self.agenda.now) for machine in machines]
        for machine in machines:
            machine.sequence += 1
        accepting = [
            reading.accepts and not machine.stopping
            for machine, reading in zip(machines, readings, strict=True)
        ]
        self._tell(
            happened.ReadingsReceived(
                host_id=np.array([one.host_id for one in machines], np.int64),
                incarnation=np.array([one.incarnation for one in machines], np.uint64),
                sequence=np.array([one.sequence for one in machines], np.uint64),
                status_sequence=np.zeros(len(machines), np.uint64),
                accepting=np.array(accepting, np.bool_), stale=np.zeros(len(machines), np.uint32),
                usage=np.array([reading.usage for reading in readings]),
                limit=np.array([machine.limit for machine in machines]),
            )
        )  # fmt: skip
        for machine, accepts in zip(machines, accepting, strict=True):
            if accepts and not machine.asked:
                machine.asked = True
                self._ask(happened.ProcessRequested(0, machine.host_id, machine.incarnation))

    def _tell_usages(self, machine: Machine) -> None:
        """Deliver the usage of each instance, if it has changed since the last time."""
        usages = machine.usages(self.agenda.now)
        if usages == machine.told_usage:
            return
        machine.told_usage = usages
        numbers, cpu, memory = zip(*usages, strict=True) if usages else ((), (), ())
        self._tell(
            happened.UsagesReceived(
                machine.host_id, machine.incarnation, np.array(numbers, np.uint64),
                np.array(cpu, np.float64), np.array(memory, np.float64),
            )
        )  # fmt: skip

    # --- the master ----------------------------------------------------------------------

    def _tell(self, event: happened.Event) -> None:
        """Process an event in the master's core, and carry out its commands."""
        now = self.agenda.now
        self.state.wall = now
        commands = step(self.state, event, now)
        self.meter.take(self.state, event, commands, now)
        for command in commands:
            if not isinstance(command, (Record, Intent)):
                self._carry_out(command)

    def _carry_out(self, command: Command) -> None:
        if isinstance(command, Reply):
            self._taken_in = command if command.host_id else self._taken_in
            return
        self._active = self.agenda.now
        if isinstance(command, Assign):
            self._assign(command)
        elif isinstance(command, SendOrder):
            self._order(command)
        elif isinstance(command, Withdraw):
            self._withdraw(command)
        elif isinstance(command, Redeliver):
            self._redeliver(command)
        elif isinstance(command, PublishStateConfig):
            self._nodes.hear(command)

    def _assign(self, command: Assign) -> None:
        machine, assignment = self._by_id[command.host_id], command.assignment
        self._undelivered.add(assignment.instance)

        def arrive() -> None:
            if machine.up and not machine.stopping and assignment.instance in self._undelivered:
                self._undelivered.discard(assignment.instance)
                self._hosting.hear(machine, AssignmentsReceived((assignment,)))

        self.agenda.after(self.workload.model.wire, arrive)

    def _withdraw(self, command: Withdraw) -> None:
        if command.instance in self._undelivered:
            self._undelivered.discard(command.instance)
            withdrawn = happened.AssignmentWithdrawn(command.instance)
            self.agenda.after(0.0, partial(self._tell, withdrawn))
            return
        self._order(command.if_fetched)

    def _redeliver(self, command: Redeliver) -> None:
        if command.assignment.instance not in self._undelivered:
            self._order(command.if_fetched)

    def _order(self, sent: SendOrder) -> None:
        machine = self._by_id[sent.host_id]

        def arrive() -> None:
            if machine.up:
                self._hosting.obey(machine, sent)
                return
            timeout = happened.OrderAnswered(sent.order_id, False, "timeout", "no answer in time")
            seconds = seconds_of(sent.order) + self.state.settings.order_retry
            self.agenda.after(seconds, partial(self._tell, timeout))

        self.agenda.after(self.workload.model.wire, arrive)
