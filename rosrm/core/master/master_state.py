"""The state of the master's core; the handlers of `reducer.py` change it in place."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Final

import numpy as np

from rosrm.core.master.commands import Command, OrderId, SendOrder
from rosrm.core.master.graph_names import node_of
from rosrm.core.master.hosts.fencing import fence_of
from rosrm.core.master.scheduling.decision import Decision, DecisionKind
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.settings import CoreSettings
from rosrm.core.master.state.applications import Application, Version
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.capabilities import Answer
from rosrm.core.master.state.demand import Demand, RankingKey
from rosrm.core.master.state.flows import Flows
from rosrm.core.master.state.gangs import Gangs
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host, HostCondition, HostTable
from rosrm.core.master.state.images import Images
from rosrm.core.master.state.intents import Unsaved, mode_intent, modes_intent, version_intent
from rosrm.core.master.state.journal_gap import JournalGap
from rosrm.core.master.state.learned_needs import MOST_PROGRAMS, Estimate, LearnedNeeds
from rosrm.core.master.state.link_queries import LinkQueries
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.modes import Modes
from rosrm.core.master.state.moving import Preemption, Rebalancing
from rosrm.core.master.state.neighbours import NeighbourRules
from rosrm.core.master.state.pending_orders import PendingOrders, Purpose
from rosrm.core.master.state.periodic import Periodic
from rosrm.core.master.state.process import (
    BEFORE_START,
    DesiredState,
    Instance,
    PendingAmendment,
    Process,
    ProcessPhase,
    ends_group,
)
from rosrm.core.master.state.queue import Queue
from rosrm.core.master.state.reloads import Reloads
from rosrm.core.master.state.replicas import ReplicationState
from rosrm.core.master.state.start_orders import StartOrders
from rosrm.core.newest import Newest
from rosrm.extensions.contracts import MigrationStrategy
from rosrm.extensions.declared_fields import Declared, UnknownCapabilities
from rosrm.extensions.placement import ChainOf, PlacementPlugins, PolicySettings
from rosrm.model.devices import HeldDevice
from rosrm.model.event_kinds import EventKind
from rosrm.model.lazy import Plain
from rosrm.model.ledger import Ledger
from rosrm.model.modes import Mode
from rosrm.model.orders import Order, ReportInstances, seconds_of
from rosrm.model.records import Intent, Record
from rosrm.model.requester import OPERATOR, Requester
from rosrm.model.sizes import size_of
from rosrm.model.values import EMPTY, LARGEST_NUMBER, Assignment, InstanceId, ProcessSpec
from rosrm.wording import sanitized

#: Number of the newest records of a process that `explain` shows.
_HISTORY: Final = 12
#: Number of instance numbers that one intent reserves.
_RESERVED: Final = 1000
#: Phases between the rejoin of a host and its report of its instances.
_BEFORE_REPORT: Final = frozenset({ProcessPhase.ASSIGNED, ProcessPhase.STARTING})
#: Phases in which a run ends; if the process has a schedule, it waits for the next run.
_ENDS_OF_RUNS: Final = frozenset({ProcessPhase.FINISHED, ProcessPhase.FAILED})
#: Most letters of the message of a record.
_LONGEST_RECORD: Final = 10_000
#: Key of a spec in the ledger: that of a process, or of a version of an application.
SpecKey = tuple[str, str, int]
PROCESS: Final = "process"
#: First and longest time, in seconds, until the order to report all instances is repeated.
REPORT_WAITS: Final = (1.0, 16.0)
#: Seconds between two records of the same kind about the same host.
RECORD_PERIOD: Final = 10.0


def process_key(name: str) -> SpecKey:
    """Return the key of a process in the ledger of specs."""
    return PROCESS, name, 0


def version_key(application: str, number: int) -> SpecKey:
    """Return the key of a version of an application in the ledger of specs."""
    return "version", application, number


class MasterState:
    """The state of the master's core, with the changes that all handlers share.

    Attributes:
        placement: the policies and filters that judge hosts.
        ledger: specs of processes and versions by their owner, with their sizes.
        declared: declarations in the offers of the selected plugins.
        time_limited: names of the processes with a time limit that are not terminal.
        scheduled: names of the processes with a schedule that are not terminal.
        nodes: ROS node (`node_of`) to the names of the processes that run it and are not terminal.
        applications: by name.
        modes: sets of applications, and the one in force.
        terminal: names of the terminal processes, in the order in which they ended.
        unamended: name of each process whose slave has not changed the running instance yet, to the
            change.
        missing_since: column of a host whose reading shows a missing status batch, to the time.
        reports_awaited: column of a host that must report all of its instances, to the back-off of
            the order.
        ended_members: principal and name of each group that has to end, because one of its
            processes has ended in this step, to the first such process.
        standbys: process name to the migration whose destination is its standby.
        wants_standby: names of the processes that ask for a standby and are not terminal, in order
            of submission, because a replay must begin them in the same order.
        held_since: time since when placement waits for first requests for work; inf: no wait.
        contact_since: time since when at least one host reports; inf: none does.
        boot: id of the boot of the master's machine, from which its clock counts; "": unknown.
        restored_at: time at which this master read its journal; -inf: it has read none.
        next_loss: time at which the next host is lost, unless it reports before; inf: none is.
        strays: process name to the numbers of the instances that a host reports although the master
            has not assigned them to it. They are stopped, and give the host no right.
        capability_answers: answers of hosts, by strategy and host, for each strategy that must
            check its hosts.
        chain_of: creates the scoring policies with other settings; None: they stay.
        scoring: settings of the scoring policies, without the weights of a mode.
        scoring_in_force: the same with these weights.
        reloads: requests to reload, and the answers to them.
        plugins: guards every call of a plugin.
        unsaved: parts that the current event has changed and the journal does not have yet.
    """

    def __init__(  # noqa: PLR0915 - a statement for each part of the state
        self,
        settings: CoreSettings,
        placement: PlacementPlugins,
        strategies: Mapping[str, MigrationStrategy],
        epoch: int,
        *,
        declared: Declared | None = None,
    ) -> None:
        self.settings = settings
        self.declared = declared or Declared()
        self.placement = placement
        self.strategies = dict(strategies)
        self.epoch = epoch
        self.hosts = HostTable()
        self.queue = Queue()
        self.processes: dict[str, Process] = {}
        self.ledger = Ledger[SpecKey]()
        self.applications: dict[str, Application] = {}
        self.modes = Modes()
        self.terminal: dict[str, None] = {}
        self.ended_members: dict[tuple[str, str], Process] = {}
        self.instances: dict[int, Instance] = {}
        self.migrations: dict[str, Migration] = {}
        self.standbys: dict[str, Migration] = {}
        self.wants_standby: dict[str, None] = {}
        self.learned = LearnedNeeds()
        self.run_times = Newest[str, float](MOST_PROGRAMS)
        self.gangs = Gangs()
        self.neighbours = NeighbourRules()
        self.start_orders = StartOrders()
        self.flows = Flows()
        self.link_queries = LinkQueries()
        self.set_aside: set[str] = set()
        self.unamended: dict[str, PendingAmendment] = {}
        self.time_limited: dict[str, None] = {}
        self.scheduled: dict[str, None] = {}
        self.nodes: dict[str, dict[str, None]] = {}
        self.preemption = Preemption()
        self.rebalancing = Rebalancing()
        self.reloads = Reloads()
        self.chain_of: ChainOf | None = None
        self.scoring: tuple[PolicySettings, ...] = ()
        self.scoring_in_force: tuple[PolicySettings, ...] = ()
        self.strays: dict[str, set[int]] = {}
        self.rankings: dict[RankingKey, Ranking] = {}
        self.rankings_version = 0
        self.placed_at: tuple[int, ...] = ()
        self.plugins = placement.calls
        self.replication = ReplicationState()
        self.capability_answers: dict[tuple[str, str], Answer] = {}
        self.images = Images()
        self.pending_orders = PendingOrders()
        self.periodic = Periodic()
        self.next_order = self.next_instance = self.reserved_instances = 1
        self.wall = 0.0
        self.boot = ""
        self.restored_at = -inf
        self.contact_since = self.next_loss = inf
        self.held_since = inf
        self.journal_gap = JournalGap()
        self.missing_since: dict[int, float] = {}
        self.reports_awaited: dict[int, Backoff] = {}
        self.stranger_refused_at = -inf
        self.ahead_since: dict[int, tuple[float, int]] = {}
        self.reviewed = -inf
        self.demands: dict[RankingKey, Demand] = {}
        self._out: list[Command] = []
        self.unsaved = Unsaved()

    # --- commands ------------------------------------------------------------------------

    def emit(self, command: Command) -> None:
        """Add a command to the outcome of the current event."""
        self._out.append(command)

    def take(self) -> list[Command]:
        """Return and clear the commands of the current event."""
        self._out += self.unsaved.take(self)
        out, self._out = self._out, []
        return out

    def record(
        self, now: float, kind: EventKind, message: str, *, process: str = "", host: str = "",
        facts: Mapping[str, Any] = EMPTY, by: Requester = OPERATOR,
    ) -> None:  # fmt: skip
        """Write a line of the event record, with the owner of the process and the requester.

        Details are in further lines of the message; only the owner and operators may read them.
        """
        known = self.processes.get(process)
        if known is not None and known.principal:
            facts = {**facts, "owner": known.principal}
        if by.name:
            message, facts = f"{message} (by {by.name})", {**facts, "by": by.name}
        message = sanitized(message, _LONGEST_RECORD, lines=True)
        self.emit(Record(kind, process, host, message, facts))
        if known is not None:
            known.history.append((now, kind, message))
            if len(known.history) > _HISTORY:
                del known.history[0]

    def record_seldom(self, host: Host, kind: EventKind, now: float, message: str) -> None:
        """Write a line about a host, unless one of that kind was written a moment ago."""
        if now - host.recorded_at.get(kind, -inf) >= RECORD_PERIOD:
            host.recorded_at[kind] = now
            self.record(now, kind, message, host=host.name)

    def save(self, process: Process) -> None:
        """Persist the desired state of a process, as it stands after the current event."""
        self.unsaved.processes[process.name] = process

    def save_migration(self, migration: Migration) -> None:
        """Persist the progress of a migration, as it stands after the current event."""
        if self.standbys.get(migration.process) is migration:
            self.save(self.processes[migration.process])
            return
        self.unsaved.migrations[migration.process] = migration

    def end_migration(self, migration: Migration) -> None:
        """Remove a migration that has ended."""
        del self.migrations[migration.process]
        self.release_ended(migration.process, migration.source_host)
        self.unsaved.migrations.pop(migration.process, None)
        self.emit(Intent("migration", migration.process, None))

    def save_application(self, application: Application) -> None:
        """Persist the desired version and the tasks of an application."""
        self.unsaved.applications[application.name] = application

    def save_version(self, application: Application, version: Version) -> None:
        """Persist a version of an application, and drop the oldest ones."""
        self.note_version(application, version)
        self.emit(version_intent(application.name, version.number, version))
        for dropped in application.keep(self.settings.keep_versions):
            self.ledger.remove(application.principal, version_key(application.name, dropped))
            self.emit(version_intent(application.name, dropped, None))

    def note_version(self, application: Application, version: Version) -> None:
        """Add a version to an application, and its size to what the owner stores."""
        application.versions[version.number] = version
        key = version_key(application.name, version.number)
        self.ledger.put(application.principal, key, size_of(version.specs))

    def save_modes(self) -> None:
        """Persist which mode is in force, and the progress of a switch."""
        self.emit(modes_intent(self.modes))

    def save_mode(self, name: str, mode: Mode | None) -> None:
        """Persist a mode; None: it is removed."""
        self.emit(mode_intent(name, mode))

    def send(self, host: Host, order: Order, purpose: Purpose | None = None) -> OrderId:
        """Send an order to the slave of a host and return its id.

        Args:
            purpose: of the answer; None: the answer is ignored.
        """
        order_id = self.pending_orders.add(purpose, seconds_of(order))
        self.emit(SendOrder(order_id, host.host_id, order))
        return order_id

    def ask_for_report(self, host: Host, now: float) -> None:
        """Order a report of all instances of a host; the tick repeats it until one arrives."""
        awaited = self.reports_awaited[host.column] = Backoff()
        awaited.note(now, *REPORT_WAITS)
        self.send(host, ReportInstances())

    def note_report(self, host: Host) -> None:
        """Note that a host has reported all of its instances."""
        self.reports_awaited.pop(host.column, None)
        self.missing_since.pop(host.column, None)
        self.hosts.set_report_due(host, report_due=False)
        host.unreached = False

    def knows_statuses(self, host: Host) -> bool:
        """Return True if a host is up, and no status of its instances is known to be missing."""
        column = host.column
        is_up = self.hosts.condition_of(host) is HostCondition.UP
        return is_up and column not in (*self.reports_awaited, *self.hosts.statuses_missing())

    # --- processes -----------------------------------------------------------------------

    def set_phase(
        self, process: Process, phase: ProcessPhase, now: float, reason: str = ""
    ) -> None:
        """Move a process to another phase; a run of a schedule ends in the phase SCHEDULED."""
        if phase in _ENDS_OF_RUNS and process.spec.schedule:
            phase, reason = self._after_run(process, phase, reason)
        process.reason = reason
        if process.phase is not phase:
            before = process.phase
            self._begin_phase(process, phase, now)
            if process.next_spec is not None and process.is_at_rest:
                self._drop_next_spec(process)
            self.start_orders.note_change(process.name)
            if process.awaits_gang or phase.is_terminal != before.is_terminal:
                self._update_terminal(process)

    def _drop_next_spec(self, process: Process) -> None:
        """End the replacement of a process that ended, but not to be started with its next spec.

        A completed process has done the work of its former version. A cancelled process has
        completed none, so it has the new version if it is started again.
        """
        spec, process.next_spec = process.next_spec, None
        if spec is not None and process.phase is ProcessPhase.CANCELLED:
            self.set_spec(process, spec)

    def _after_run(
        self, process: Process, end: ProcessPhase, reason: str
    ) -> tuple[ProcessPhase, str]:
        """Return phase and reason of a process between two runs of its schedule."""
        process.wanted, process.overdue, process.killed = DesiredState.RUN, False, False
        if not process.next_run:  # its first run has not started
            process.next_run = process.spec.schedule.next_run(self.wall)
        details = f": {reason}" if reason else ""
        return ProcessPhase.SCHEDULED, f"its last run {end.value}{details}"

    def _begin_phase(self, process: Process, phase: ProcessPhase, now: float) -> None:
        """Change the phase and note its start.

        A process that was unreachable and returns to its former phase keeps that phase's start.
        """
        before, began = process.phase, (now, self.wall)
        if phase is ProcessPhase.UNREACHABLE:
            process.phase_before_loss = (before, process.since, process.wall)
        elif process.phase_before_loss is not None and phase not in _BEFORE_REPORT:
            if process.phase_before_loss[0] is phase:
                began = process.phase_before_loss[1:]
            process.phase_before_loss = None
        process.phase = phase
        process.since, process.wall = began
        if process.awaits_gang and phase not in (*BEFORE_START, ProcessPhase.UNREACHABLE):
            self.gangs.leave(process)
        if ends_group(process):
            key = process.principal, process.spec.group.name
            self.ended_members.setdefault(key, process)

    def add_process(self, process: Process) -> None:
        """Add a process; it replaces a terminal one of the same name."""
        former = self.processes.pop(process.name, None)  # listings are in order of submission
        if former is not None:
            self.ledger.remove(former.principal, process_key(process.name))
        self.processes[process.name] = process
        self.ledger.put(process.principal, process_key(process.name), size_of(process.spec))
        self._update_terminal(process)
        self.start_orders.note_change(process.name)

    def _update_terminal(self, process: Process) -> None:
        """Update `terminal`, which stays in the order in which processes ended."""
        if not process.phase.is_terminal:
            self.terminal.pop(process.name, None)
            if process.spec.time_limit:
                self.time_limited.setdefault(process.name)
            if process.spec.schedule:
                self.scheduled.setdefault(process.name)
            if process.spec.standby.wanted:
                self.wants_standby.setdefault(process.name)
            if process.awaits_gang:
                self.gangs.add(process)
            if process.spec.neighbours:
                self.neighbours.add(process.spec)
            if process.spec.start_order.after:
                self.start_orders.add(process.spec)
            if process.node:
                self.nodes.setdefault(process.node, {})[process.name] = None
            self.flows.declare(process.name, process.spec.talks_to)
        else:
            self.terminal.setdefault(process.name)
            self.wants_standby.pop(process.name, None)
            self.time_limited.pop(process.name, None)
            self.scheduled.pop(process.name, None)
            self.neighbours.remove(process.name)
            self.start_orders.remove(process.name)
            self._forget_node(process)
            self.flows.remove(process.name)

    def _forget_node(self, process: Process) -> None:
        users = self.nodes.get(process.node, {})
        users.pop(process.name, None)
        if not users:
            self.nodes.pop(process.node, None)

    def set_spec(self, process: Process, spec: ProcessSpec) -> None:
        """Replace the spec of a process, and note what other parts of the state read of it."""
        in_line = process.name in self.queue
        if in_line:
            self.unqueue(process)
        awaits_gang = process.awaits_gang
        if spec.together != process.spec.together:
            awaits_gang = bool(spec.together) and (awaits_gang or in_line)
            self.gangs.leave(process)
        self._forget_node(process)
        process.spec, process.plain, process.node = spec, Plain(spec), node_of(spec)
        self.ledger.put(process.principal, process_key(process.name), size_of(spec))
        process.demand, process.awaits_gang = None, awaits_gang
        process.moves.clear()
        self.wants_standby.pop(process.name, None)
        self.time_limited.pop(process.name, None)
        self.scheduled.pop(process.name, None)
        self.neighbours.remove(process.name)
        self.start_orders.remove(process.name)
        self._update_terminal(process)
        if in_line:
            self.put_in_queue(process)
        self.queue.note_places(process)
        self.start_orders.note_change(process.name)
        self.save(process)

    def amend_spec(self, process: Process, spec: ProcessSpec) -> None:
        """Change a spec in fields that need no new start; the instances of that spec follow."""
        former = process.spec
        self.set_spec(process, spec)
        for instance in self.instances_of(process):
            if instance.spec == former:
                instance.spec = spec
                instance.host.instances[instance.id.number] = process.name, spec
                if spec.needs != former.needs and not instance.stopping:
                    needs = self.estimate(spec)
                    instance.demand, instance.estimated = needs.amounts, needs.estimated
                    self.reserve_rest(instance)

    def replacement_of(self, process: Process) -> Migration | None:
        """Return the migration that replaces a process by another version, before its commit."""
        migration = self.migrations.get(process.name)
        if migration is None or migration.spec is None or migration.committed:
            return None
        return migration

    def spec_to_be(self, process: Process) -> ProcessSpec:
        """Return the spec of a process after the replacement that is under way, if one is."""
        migration = self.replacement_of(process)
        if migration is not None and migration.spec is not None and migration.undo is None:
            return migration.spec
        return process.next_spec or process.spec

    def may_run(self, process: Process) -> bool:
        """Return True if an instance or a standby of a process may run."""
        return bool(process.instances) or process.name in self.standbys

    def enqueue(self, process: Process, now: float, reason: str = "") -> None:
        """Queue a process at its place, given by its priority and order of submission."""
        if process.next_spec is not None:
            self.set_spec(process, process.next_spec)
            process.next_spec = None
        process.owner, process.ended_on = 0, ""
        process.wanted, process.overdue, process.cancel_cause = DesiredState.RUN, False, ""
        process.killed = False
        process.started_at, process.began = inf, 0.0
        if process.left_behind is None:
            process.ran_before = 0.0
        process.restart_due, process.strays_until = False, 0.0
        self.flows.note_change(process.name)
        self.set_phase(process, ProcessPhase.QUEUED, now, reason)
        self.put_in_queue(process)

    def put_in_queue(self, process: Process) -> None:
        """Add a process whose phase is QUEUED to the queue."""
        self.queue.add(process)
        self.start_orders.note_change(process.name)
        able = self.declared.capabilities_of(process.spec)
        if process.name in self.strays or isinstance(able, UnknownCapabilities):
            self.start_orders.to_review[process.name] = None
        if process.queue_delay:
            self.queue.delayed.add(process.name)

    def unqueue(self, process: Process) -> None:
        """Remove the process from the queue and from the set-aside list."""
        if process.name in self.queue:
            self.queue.remove(process.name)
        self.set_aside.discard(process.name)

    def names_of(self, application: str) -> list[str]:
        """Return the names of the processes of an application, also of ended ones."""
        return [
            name for name, process in self.processes.items()
            if process.spec.application == application
        ]  # fmt: skip

    def instances_of(self, owner: Process | Host) -> list[Instance]:
        """Return every instance of a process, or on a host, that may still run."""
        return [self.instances[number] for number in sorted(owner.instances)]

    def images_on(self, host: Host) -> list[str]:
        """Return the names of the checkpointed processes whose image is on a host."""
        images = ((name, self.processes[name].image) for name in sorted(self.images.of))
        return [name for name, image in images if image is not None and image.host == host.name]

    def owned_by(self, instance: Instance) -> Process | None:
        """Return the process whose name this instance owns; None: it is not the owner.

        A stray owns no name, even if it was the owner until it was given up with its lost host.
        """
        process = self.processes.get(instance.id.process)
        is_owner = process and process.owner == instance.id.number and not instance.stray
        return process if is_owner else None

    def owner_of(self, process: Process) -> Instance | None:
        """Return the instance that owns the name of a process; None: none that is no stray."""
        owner = self.instances.get(process.owner)
        return None if owner is None or owner.stray else owner

    # --- instances -----------------------------------------------------------------------

    def new_instance_id(self, process: Process) -> InstanceId:
        """Return an instance id with a number that no run of the master has used."""
        if self.next_instance >= self.reserved_instances:
            self._reserve_numbers()
        self.next_instance += 1
        return InstanceId(process.name, self.next_instance - 1)

    def _reserve_numbers(self) -> None:
        self.reserved_instances = self.next_instance + _RESERVED
        self.emit(Intent("cluster", "instances", {"next": self.reserved_instances}))

    def skip_numbers(self, seen: int) -> None:
        """Skip instance numbers that a slave reports and the journal has lost.

        Instances that have ended since may have had later numbers, so a reserve is skipped too.
        """
        if self.next_instance <= seen < LARGEST_NUMBER:
            self.next_instance = seen + _RESERVED
            self._reserve_numbers()  # at once, because no slave may report the number again

    def estimate(self, spec: ProcessSpec) -> Estimate:
        """Return the needs of one instance of a spec."""
        return self.learned.estimate(spec, self.settings.default_needs)

    def _numbers_with(self, instance: Instance) -> set[int]:
        """Return the instance numbers of a process, or those of its strays."""
        name = instance.id.process
        if instance.stray:
            return self.strays.setdefault(name, set())
        return self.processes[name].instances

    def add_instance(
        self, instance: InstanceId, spec: ProcessSpec, host: Host, now: float,
        needs: Estimate | Demand, fractions: FloatArray | None = None, *,
        devices: tuple[HeldDevice, ...] = (), stray: bool = False,
    ) -> Instance:  # fmt: skip
        """Add an instance, and reserve its needs and devices on its host.

        Args:
            spec: spec with which it is started, or was started.
            fractions: (R,) needs as shares of the host's capacity, where they are known already.
            stray: the master has not assigned it to this host.
        """
        if fractions is None:
            fractions = self.hosts.fractions_of(host, needs.amounts, needs.estimated)
        reserved = np.where(fractions < np.inf, fractions, 0.0)
        added = Instance(
            instance, host, spec, now, needs.amounts, needs.estimated, reserved, devices=devices,
            stray=stray,
        )  # fmt: skip
        self.hosts.hold(host, instance, devices)
        self.instances[instance.number] = added
        host.instances[instance.number] = instance.process, spec
        self._numbers_with(added).add(instance.number)
        self.hosts.add_reservation(host, reserved, processes=1)
        self.note_change(instance.process)
        return added

    def reserve(
        self, instance: InstanceId, spec: ProcessSpec, host: Host, now: float, ranking: Ranking
    ) -> None:
        """Add an instance on the host that a ranking has chosen."""
        demand = ranking.demand
        # Without devices the slave refuses the instance, and the process is placed elsewhere.
        needs = spec.devices
        chosen = (self.hosts.devices[host.column].choose(needs) or ()) if needs else ()
        need = ranking.need[:, host.column]
        self.add_instance(instance, spec, host, now, demand, need, devices=chosen)

    def reserve_rest(self, instance: Instance) -> None:
        """Reserve the part of the demand of an instance that the readings do not show yet."""
        reserved = self.rest_of(instance)
        change = reserved.copy()
        change[: len(instance.reserved)] -= instance.reserved
        if np.any(change):
            instance.reserved = reserved
            self.hosts.add_reservation(instance.host, change)

    def rest_of(self, instance: Instance) -> FloatArray:
        """Return the part of the demand of an instance that is to be reserved, fractions.

        An estimate ends after `settle`. Usage that was measured before a move ends when the
        readings show the instance at its new host. The declared needs stay.
        """
        host, needs, left = instance.host, instance.spec.needs, dict[str, float]()
        ended = host.shared if instance.shown else frozenset()
        for resource, placed in instance.demand.items():
            is_over = instance.settled if resource in instance.estimated else instance.shown
            amount = min(placed, needs.get(resource, 0.0)) if is_over else placed
            shown = instance.seen.get(resource, 0.0) if resource in host.attributed else 0.0
            if amount > shown and resource not in ended:
                left[resource] = amount - shown
        fractions = self.hosts.fractions_of(host, left, instance.estimated)
        return np.where(fractions < np.inf, fractions, 0.0)

    def note_held(self, instance: Instance, devices: tuple[HeldDevice, ...]) -> None:
        """Note the devices that an instance holds by the report of its slave.

        A slave releases no device of a running instance, so an empty report means "unknown".
        """
        if devices and instance.devices != devices:
            instance.devices = devices
            self.hosts.hold(instance.host, instance.id, devices)
            self.hosts.touch(instance.host)
            process = self.processes.get(instance.id.process)
            if process is not None:
                self.save(process)

    def release_ended(self, name: str, host: Host) -> None:
        """Release the devices that stay reserved for ended instances of a process on a host."""
        for one in list(self.hosts.devices[host.column].held):
            if one.process == name and one.number not in self.instances:
                self.hosts.hold(host, one, ())
                self.hosts.touch(host)

    def _may_return(self, instance: Instance) -> bool:
        """Return True if a migration may start its source again in place of an ended instance."""
        migration = self.migrations.get(instance.id.process)
        return (
            migration is not None
            and not migration.committed
            and migration.source_host is instance.host
        )

    def note_change(self, name: str) -> None:
        """Note that the instances of a process, or the one that owns its name, have changed."""
        self.neighbours.note_change(name)
        self.flows.note_change(name)
        if name in self.processes:
            self.queue.note_places(self.processes[name])

    def drop_instance(self, instance: Instance) -> None:
        """Remove an ended instance and its reservation."""
        del self.instances[instance.id.number]
        instance.host.instances.pop(instance.id.number, None)
        name = instance.id.process
        self._numbers_with(instance).discard(instance.id.number)
        if instance.stray:
            self.start_orders.to_review[name] = None
            if not self.strays[name]:
                del self.strays[name]
        if instance.devices and not self._may_return(instance):
            self.hosts.hold(instance.host, instance.id, ())
        self.hosts.add_reservation(instance.host, -instance.reserved, processes=-1)
        self.note_change(name)

    def clear_left_behind(self, process: Process) -> None:
        """Note that no instance of a process on a lost host counts as its own any more."""
        process.left_behind, process.ran_before = None, 0.0
        self.neighbours.note_change(process.name)

    def assignment(
        self, instance: InstanceId, spec: ProcessSpec, node_name: str = "", *,
        shadow: bool = False, restored: bool = False, inactive: bool = False,
    ) -> Assignment:  # fmt: skip
        """Return the assignment by which a slave runs an instance of a known process."""
        fence = fence_of(spec, self.settings)
        known = self.instances.get(instance.number)
        snapshot_hosts: tuple[str, ...] = ()
        snapshots_from = 0
        if self.declared.may_have_snapshots(spec):
            process = self.processes[spec.name]
            snapshots_from = max(1, process.born)  # 0: no snapshots
            if not shadow and not restored:
                snapshot_hosts = self.replication.in_reach(
                    spec.name, process.born, self.hosts, process.ran_on
                )
        return Assignment(
            instance, spec, self.epoch, node_name or spec.node, shadow, fence, snapshot_hosts,
            snapshots_from, restored, devices=known.devices if known else (), inactive=inactive,
        )  # fmt: skip

    def note_decision(
        self, process: Process, decision: Decision, kind: DecisionKind, now: float
    ) -> None:
        """Note the newest decision about a process, for `explain`."""
        decision.kind = kind
        process.decision, process.decided_at = decision, now
