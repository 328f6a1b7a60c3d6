"""Engine of a simulation: the master's core and the slaves' cores on virtual time.

The master's core gets the same events as in reality, with real policies, strategies and settings.
Its commands reach the hosts after the time that a message takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.commands import (
    Assign,
    Command,
    Reply,
    SendOrder,
)
from rosrm.core.master.hosts.links import note_report
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.settings import CoreSettings
from rosrm.core.slave.events import AssignmentsReceived, TimePassed
from rosrm.extensions.contracts import MigrationStrategy
from rosrm.extensions.declared_fields import Declared
from rosrm.extensions.placement import PlacementPlugins
from rosrm.model.links import Interface, LinkReport
from rosrm.model.orders import seconds_of
from rosrm.model.records import Intent, Record
from rosrm.model.values import EMPTY, Assignment
from rosrm_simulate.agenda import Agenda
from rosrm_simulate.machine import Machine
from rosrm_simulate.meter import Meter, Outcome
from rosrm_simulate.nodes import Nodes
from rosrm_simulate.workload import SimulatedHost, Workload
from rosrm_simulate.world import World

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


class Simulation(World[Machine]):
    """One run of a workload.

    Args:
        workload: to be run; its first arrival must not be after its end.
        settings: of the master's core.
        placement: the policies and filters that judge hosts.
        strategies: by name.
        declared: declarations of their offers. A simulated host has all executors.
    """

    def __init__(
        self,
        workload: Workload,
        settings: CoreSettings,
        placement: PlacementPlugins,
        strategies: Mapping[str, MigrationStrategy],
        declared: Declared | None = None,
    ) -> None:
        settings = replace(
            settings,
            link_period=0.0,  # the links of a workload are known from the start
            max_hosts=max(settings.max_hosts, len(workload.hosts)),
            max_processes=max(settings.max_processes, len(workload.processes)),
        )
        super().__init__(
            MasterState(
                settings, placement, strategies, epoch=1,
                declared=replace(declared or Declared(), executors=EMPTY),
            )
        )  # fmt: skip
        self.workload = workload
        self.meter = Meter(workload.until)
        self.agenda = Agenda()
        self._plans = {plan.name: plan for plan in workload.processes}
        self.publish = Nodes(self.agenda, workload.model, self.machines, self.tell).handle
        self._active = 0.0
        self._usage_published_at = -1
        # After this long without any event, the passing of time alone has no further effect.
        self._patience = 2.0 + max(
            settings.settle, settings.hysteresis, settings.cooldown, settings.delivery_timeout,
            settings.lease, settings.order_retry,
            settings.rebalance_after if settings.rebalance else 0.0,
            *(one.spec.time_limit for one in workload.processes),
            *(one.spec.reschedule.delay for one in workload.processes),
        )  # fmt: skip

    def run(self, progress: Callable[[Progress], None] | None = None) -> Outcome:
        """Run until nothing can change any more, or until the workload's `until`."""
        self._plan()
        next_tick, shown = 0.0, 0
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
            if progress is not None and self.meter.events - shown >= _TELL_EVERY:
                shown = self.meter.events
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
        for plan in self.workload.processes:
            together.setdefault(plan.arrives, []).append(plan.name)
        for time, names in together.items():
            submitted = happened.SubmissionReceived(
                0, tuple(self._plans[name].spec for name in names)
            )
            self.agenda.at(time, partial(self.request, submitted))
        for time, event in self.workload.requests:
            self.agenda.at(time, partial(self.request, event))

    def _join(self, plan: SimulatedHost) -> None:
        machine = Machine(
            plan, len(self.machines) + 1, self.agenda, self.workload.model, self._plans, self.tell
        )
        self.machines[plan.name] = machine
        self.join(machine, inf)  # no simulated host is cut off
        self._measure_links(plan)
        self._read([machine])

    def _measure_links(self, joined: SimulatedHost) -> None:
        """Report the links of a host that has joined, and those of the others to it."""
        table, plans = self.state.hosts, {one.name: one for one in self.workload.hosts}
        others = [plans[host.name] for host in table.listed() if host.name != joined.name]
        for one, peers in [(joined, others), *((other, [joined]) for other in others)]:
            trips = {
                table.by_name[peer.name].host_id: (0, one.link.round_trip + peer.link.round_trip)
                for peer in peers if one.link is not None and peer.link is not None
            }  # fmt: skip
            if one.link is not None:
                interfaces = (Interface(one.link.rate),)
                report = LinkReport(limit=one.link.limit, interfaces=interfaces, peers=trips)
                note_report(self.state, table.by_name[one.name], report, self.now)

    def _leave(self, plan: SimulatedHost) -> None:
        machine = self.machines[plan.name]
        if plan.lost:
            machine.lose()
            return
        self.request(happened.HostLeft(0, machine.host_id, machine.incarnation))
        machine.shut_down(self.now)

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
        if turn != self._usage_published_at:
            self._usage_published_at = turn
            for machine in there:
                self._tell_usages(machine)
                machine.tell(TimePassed(), now)
        self.tell(happened.TimePassed())

    def _read(self, machines: list[Machine]) -> None:
        """Deliver readings of hosts to the master; hosts under their limits request work."""
        # 0: a reading is never ahead of the statuses, which take their time.
        event = self.readings(machines, status_sequence=np.zeros(len(machines), np.uint64))
        self.tell(event)
        for machine, accepts in zip(machines, event.accepting, strict=True):
            if accepts and not machine.asked:
                machine.asked = True
                self.request(happened.ProcessRequested(0, machine.host_id, machine.incarnation))

    def _tell_usages(self, machine: Machine) -> None:
        """Deliver the usage of each instance, if it has changed since the last time."""
        used = machine.used(self.now)
        if used != machine.published_usage:
            machine.published_usage = used
            self.tell(machine.usages(self.now))

    # --- the world, on virtual time ------------------------------------------------------

    @property
    def now(self) -> float:
        """Return the virtual time, seconds."""
        return self.agenda.now

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        """Plan an action."""
        self.agenda.after(seconds, action)

    def record(self, event: happened.Event, commands: Sequence[Command]) -> None:
        """Measure a step of the master's core."""
        self.meter.take(self.state, event, commands, self.now)
        if any(not isinstance(command, (Record, Intent, Reply)) for command in commands):
            self._active = self.now

    def assign(self, host: Machine, command: Assign) -> None:
        """Hand an assignment to a host, which receives it later."""
        super().assign(host, command)
        self.after(self.workload.model.wire, partial(self._fetch, host, command.assignment))

    def _fetch(self, host: Machine, assignment: Assignment) -> None:
        if host.up and not host.stopping and assignment in host.polled:
            host.polled.remove(assignment)
            host.tell(AssignmentsReceived((assignment,)), self.now)

    def send(self, sent: SendOrder) -> None:
        """Send an order to a slave, which receives it later; a lost host lets it time out."""
        self.after(self.workload.model.wire, partial(self._arrive, sent))

    def _arrive(self, sent: SendOrder) -> None:
        machine = self.by_id(sent.host_id)
        if machine.up:
            machine.receive(sent)
            return
        timeout = happened.OrderAnswered.missing(sent.order_id)
        seconds = seconds_of(sent.order) + self.state.settings.order_retry
        self.after(seconds, partial(self.tell, timeout))
