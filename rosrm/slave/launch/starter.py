"""Start of accepted assignments: fetch their files, start the process, await its node."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.config.settings import HostConfig
from rosrm.core.slave import commands, events
from rosrm.core.slave.state import HeldInstance, SlaveState
from rosrm.errors import LaunchError, assert_never, describe_fault
from rosrm.model.adoption import NO_ADOPTION
from rosrm.model.values import Assignment, InstanceId, InstanceState, InstanceStatus
from rosrm.ros.names import STATE_CONFIG, Names
from rosrm.ros.slave.endpoint import SlaveEndpoint
from rosrm.ros.slave.graph import GraphWatch
from rosrm.runtime.path_calls import NoAnswer, PathCalls, at
from rosrm.runtime.ros_wheels import without_bootstrapper
from rosrm.slave.artifacts.service import ArtifactService
from rosrm.slave.epoch import EPOCH_NOTE
from rosrm.slave.launch.command import (
    PlainLaunch,
    key_path,
    order_of,
    plain_launch,
    write_files,
)
from rosrm.slave.launch.environment import ProcessLocation, no_key
from rosrm.slave.launch.lanes import Lanes
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.memos import to_memo
from rosrm.slave.replication.service import ReplicationService
from rosrm.slave.sessions import SessionTable
from rosrm.slave.supervisor_client import SupervisorLink, amended
from rosrm.supervisor.client_values import LaunchOrder
from rosrm.supervisor.secret_files import is_exposed
from rosrm.wording import one_line

_CANNOT_ADOPT: Final = (
    "a supervisor of an earlier version runs here, which adopts no process; it ends when all its "
    "processes have ended"
)

_log = logging.getLogger("rosrm.slave")


#: An assignment, and its order or why there is none.
_Made = tuple[Assignment, PlainLaunch | LaunchOrder | LaunchError]


class _Orders:
    """Orders that a thread makes one after the other, and the loop takes.

    Attributes:
        current: the assignment that the thread is at; None: it has finished.
    """

    def __init__(
        self, assignments: Sequence[Assignment],
        order: Callable[[Assignment], PlainLaunch | LaunchOrder],
    ) -> None:  # fmt: skip
        self.current: Assignment | None = None
        self._left = deque(assignments)
        self._made: list[_Made] = []
        self._order = order
        self._lock = threading.Lock()

    def make(self) -> None:
        """Make the orders that are left."""
        while self._next():
            assert self.current is not None
            try:
                made: _Made = self.current, self._order(self.current)
            except (LaunchError, NoAnswer) as error:
                made = self.current, LaunchError(str(error))
            with self._lock:
                self._made.append(made)

    def _next(self) -> bool:
        with self._lock:
            self.current = self._left.popleft() if self._left else None
            return self.current is not None

    def take(self) -> tuple[list[_Made], list[Assignment]]:
        """Take the orders made so far, and the assignments behind the current one."""
        with self._lock:
            taken = self._made, list(self._left)
            self._made = []
            self._left.clear()
            return taken


@dataclass
class Starter:
    """Conversion of assignments into orders for the supervisor, after their files arrived.

    Attributes:
        snapshots: directory of the snapshots.
        state: instances of the slave; read-only here.
        lanes: threads of the starts that ask a plugin, which may hang.
        paths: threads for what touches paths of users.
        take: takes events for the core.
        instance_key: returns the key of an instance; None: with `security: none`.
    """

    config: HostConfig
    snapshots: Path
    state: SlaveState
    supervisor: SupervisorLink
    endpoint: SlaveEndpoint
    replication: ReplicationService
    artifacts: ArtifactService
    graph: GraphWatch
    sessions: SessionTable
    launchers: Launchers
    lanes: Lanes
    paths: PathCalls
    take: Callable[[events.Event], None]
    instance_key: Callable[[InstanceId], bytes | None] = no_key
    _environment: Mapping[str, str] = field(init=False)
    _graph_before: dict[InstanceId, frozenset[bytes]] = field(init=False, default_factory=dict)
    _launching: dict[InstanceId, Assignment] = field(init=False, default_factory=dict)
    _closed: bool = field(init=False, default=False)
    _warned_of: set[str] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        own = {**os.environ, **self.config.ros.environment()}
        self._environment = without_bootstrapper(own)

    def launch(self, assignments: Sequence[Assignment], slots: int = 0) -> None:
        """Start assignments, each as soon as its artifacts and its snapshot are on this host.

        Args:
            slots: as in `LaunchOrder`.
        """
        # A later event of the same batch may have removed an instance, as its supervisor is gone.
        wanted = [one for one in assignments if one.instance in self.state.held]
        for one in wanted:
            if one.spec.artifacts:
                self.artifacts.prepare(one, self._fetched)
        ready = self._start_prepared([one for one in wanted if not one.spec.artifacts], slots)
        # A fetch or a sync may take long, and the supervisor reports nothing before the start.
        # Without this report the master would withdraw the assignment.
        self._report(*(one for one in wanted if one not in ready))

    def _start_prepared(
        self, assignments: Sequence[Assignment], slots: int = 0
    ) -> list[Assignment]:
        """Start those assignments whose snapshots are here, and return them; prepare the others."""
        ready = [one for one in assignments if self.replication.prepare(one, self._prepared)]
        if ready:
            self._start(ready, slots)
        return ready

    def call_off(self, command: commands.SupervisorCommand) -> bool:
        """Apply a command to an instance that the supervisor does not have yet.

        Such an instance waits for its artifacts, its snapshot or a path. Returns False if the
        supervisor has to execute the command.
        """
        match command:
            case commands.Renew() | commands.Forget():
                return False  # never about an instance that waits
            case commands.Stop(instance) | commands.Fence(instance):
                if not self._is_preparing(instance):
                    return False
                self.artifacts.forget(instance)
                self.replication.forget(instance)
                self._launching.pop(instance, None)
                refusal = "it was stopped before it was started"
                self.take(events.LaunchRefused(instance, refusal))
            case commands.Amend(instance, amendment):
                if not self._is_preparing(instance):
                    return False
                self.take(events.AmendmentRecorded(instance, amendment))  # `_completed` applies it
            case commands.Restart(instance) | commands.Remember(instance):
                return self._is_preparing(instance)  # the start follows, with the newest memo
            case commands.Fail(instance):
                return self._is_preparing(instance)  # it has no run that the order could mean
            case _:
                assert_never(command)
        return True

    def close(self) -> None:
        """Start no further instances; those whose orders are being made have not begun."""
        self._closed = True

    def has_begun(self, instance: InstanceId) -> bool:
        """Return True if the supervisor has or had the instance."""
        return instance not in self.state.waiting and not self._is_preparing(instance)

    def _is_preparing(self, instance: InstanceId) -> bool:
        return (
            instance in self._launching
            or self.artifacts.is_preparing(instance)
            or self.replication.is_preparing(instance)
        )

    def preparing(self) -> list[InstanceStatus]:
        """Return the statuses of the instances whose orders the supervisor does not have yet."""
        held = self.state.held.items()
        return [one.status for instance, one in held if self._is_preparing(instance)]

    def look_at_graph(self, awaited: Mapping[InstanceId, HeldInstance]) -> None:
        """Report the awaited nodes that are in the ROS graph now."""
        for instance, held in awaited.items():
            before = self._graph_before.get(instance, frozenset())
            pids = self.sessions.known_as(held.status.pid)
            if held.awaited and self.graph.sees(held.awaited.node_name, pids, before):
                self.take(events.SeenInGraph(instance))

    def ended(self, instance: InstanceId) -> None:
        """Stop awaiting the node of an instance."""
        self._graph_before.pop(instance, None)
        key = key_path(self.supervisor.state, instance)
        self.paths.run(partial(_remove, key), _ignore, _ignore)  # otherwise removed with the log
        self.replication.ended(instance)

    def _fetched(self, assignment: Assignment, fault: str) -> None:
        if fault:
            self._refuse(assignment.instance, fault)
        elif self._is_wanted(assignment):
            self._start_prepared([assignment])

    def _prepared(self, assignment: Assignment) -> None:
        if self._is_wanted(assignment):
            self._start([assignment])

    def _is_wanted(self, assignment: Assignment) -> bool:
        """Return True if an instance is still to be started after its files have arrived."""
        held = self.state.held.get(assignment.instance)
        starting = held is not None and held.status.state is InstanceState.STARTING
        return starting and not self._closed

    def _refuse(self, instance: InstanceId, reason: str) -> None:
        _log.info("%s cannot be started here: %s", instance, one_line(reason))
        self.take(events.LaunchRefused(instance, reason))

    def _start(self, assignments: Sequence[Assignment], slots: int = 0) -> None:
        """Have a thread make the orders, because they depend on paths that users name."""
        for assignment in assignments:
            held = self.state.held[assignment.instance]
            if held.awaited is not None:
                before = self._seen_before(assignment, held.awaited.node_name)
                self._graph_before[assignment.instance] = before
            self._launching[assignment.instance] = assignment
        orders = _Orders(assignments, partial(self._order, where=self._location()))
        take = partial(self._take_orders, orders, slots)

        def late() -> None:
            take()
            self._report(orders.current)

        def held_up(error: Exception) -> None:
            if orders.current is None:  # no thread could begin: another try would fail as well
                refused = orders.take()[1]
            else:
                take()
                refused = [orders.current]
            self._send([(one, LaunchError(str(error))) for one in refused], slots)

        self.paths.run(orders.make, lambda _: take(), held_up, late=late)

    def _report(self, *assignments: Assignment | None) -> None:
        """Report starts that may take long, because the master would withdraw them otherwise."""
        instances = [one.instance for one in assignments if one is not None]
        waiting = [self.state.held[one].status for one in instances if one in self.state.held]
        if waiting:
            self.endpoint.publish_statuses(waiting, complete=False)

    def _take_orders(self, orders: _Orders, slots: int) -> None:
        """Send what has been made; make the orders behind a late one in another thread."""
        made, left = orders.take()
        self._send(made, slots)
        wanted = (
            []
            if self._closed
            else [one for one in left if self._launching.get(one.instance) is one]
        )
        if wanted:
            self._start(wanted, slots)

    def _order(self, assignment: Assignment, where: ProcessLocation) -> PlainLaunch | LaunchOrder:
        """Return the order of an assignment, or its launch if a plugin has to be asked.

        Called in a thread. Raises `LaunchError`, or `NoAnswer`.
        """
        self._check_supervisor(assignment)
        self._check_secrets(assignment)
        plain = plain_launch(
            assignment, self._environment, sys.executable, where=where,
            state_directory=self.supervisor.state, launchers=self.launchers,
        )  # fmt: skip
        if not self.supervisor.writes_files:
            write_files(plain.contents)
        return plain if _lane_of(assignment) else order_of(plain, self.launchers, where.host)

    def _send(self, made: Sequence[_Made], slots: int) -> None:
        """Send the orders of instances that are still wanted, after their plugins were asked."""
        orders = []
        for assignment, order in made:
            instance = assignment.instance
            is_due = self._launching.get(instance) is assignment and not self._closed
            if not is_due or instance not in self.state.held:
                continue
            if isinstance(order, PlainLaunch):
                ask = partial(order_of, order, self.launchers, self.config.host)
                done = partial(self._ordered, assignment, slots)
                self.lanes.run(_lane_of(assignment), ask, done)
                self._report(assignment)
                continue
            del self._launching[instance]
            if isinstance(order, LaunchOrder):
                orders.append(self._completed(order, slots))
            else:
                self._refuse(instance, str(order))
        if orders:
            self.supervisor.start(orders)

    def _completed(self, order: LaunchOrder, slots: int) -> LaunchOrder:
        held = self.state.held[order.instance]
        order = order if held.amended is None else amended(order, held.amended)
        contact = self.state.last_contact
        return replace(order, memo=to_memo(held.memo), slots=slots, last_contact=contact)

    def _ordered(
        self, assignment: Assignment, slots: int, outcome: LaunchOrder | BaseException
    ) -> None:
        """Start an instance whose launcher has answered, or refuse it."""
        instance = assignment.instance
        if self._closed or instance not in self._launching:  # it was stopped
            return
        del self._launching[instance]
        if isinstance(outcome, LaunchOrder):
            if self._is_wanted(assignment):
                self.supervisor.start([self._completed(outcome, slots)])
        elif isinstance(outcome, LaunchError):
            self._refuse(instance, str(outcome))
        else:
            reason = f"{instance}: the launcher of {_lane_of(assignment)!r} fails: "
            self._refuse(instance, reason + describe_fault(outcome))

    def _seen_before(self, assignment: Assignment, node: str) -> frozenset[bytes]:
        """Return the endpoints of a node that do not show that the instance is ready.

        The node of a process that is adopted is in the graph already.
        """
        is_adopted = assignment.spec.adoption != NO_ADOPTION
        return frozenset() if is_adopted else self.graph.endpoints(node)

    def _check_supervisor(self, assignment: Assignment) -> None:
        if assignment.spec.adoption != NO_ADOPTION and not self.supervisor.adopts:
            raise LaunchError(f"{assignment.instance}: {_CANNOT_ADOPT}")

    def _check_secrets(self, assignment: Assignment) -> None:
        """Warn of secrets that every user of this host may read; raises `LaunchError`."""
        secrets = assignment.spec.secrets
        if secrets and not self.supervisor.reads_secrets:
            raise LaunchError(
                f"{assignment.instance}: a supervisor of an earlier version runs here, which reads "
                "no secrets; it ends when all its processes have ended"
            )
        for path in secrets.values():
            at(path)
            if path not in self._warned_of and is_exposed(path):
                self._warned_of.add(path)
                _log.warning(
                    "%s: the file of a secret may be read or changed by every user of this host; "
                    "`chmod o-rw %s` prevents this",
                    assignment.instance, path,
                )  # fmt: skip

    def leave_out(self, seconds: float) -> None:
        """Prolong the fetches by a suspend of this machine."""
        self.artifacts.leave_out(seconds)
        self.replication.leave_out(seconds)

    def _location(self) -> ProcessLocation:
        config = self.config
        return ProcessLocation(
            config.host, self.endpoint.cluster, Names(config.ros.namespace)(STATE_CONFIG),
            self.snapshots, config.keep.every, config.state / EPOCH_NOTE, self.instance_key,
            self.endpoint.description.devices, self.artifacts.root,
        )  # fmt: skip


def _lane_of(assignment: Assignment) -> str:
    """Return the lane of a start that asks a launcher or a strategy; "": it asks none."""
    spec = assignment.spec
    restored = "restored" if assignment.restored else ""
    return spec.container.engine or spec.migration.strategy or restored


def _remove(path: Path) -> None:
    at(path)
    path.unlink(missing_ok=True)


def _ignore(_outcome: object) -> None:
    """Ignore an outcome."""
