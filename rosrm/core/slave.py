"""The slave's reducer: (state, event, now) -> commands. Each kind of event is one row below.

======================  =========================================================================
what happened           what the core does
======================  =========================================================================
Registered              remembers the master's epoch; older ones are refused from now on
MasterLost              forgets no end until a master has taken this host in again
AssignmentsReceived     has them launched, once, or holds them until a slot is free; one that was
                        stopped before is refused
LaunchRefused           reports that the host cannot run it, and why
StopOrdered             has it stopped; one never heard of will never be started
RestartOrdered          has it stopped and started again here
RestartPolicySet        has the supervisor keep it, unless it has ended or is not known: settled
RestartPolicyRecorded   the supervisor has it in its record: settled
ReportRequested         reports everything
SupervisorReported      follows the instance; a new run must become ready anew
SupervisorReplaced      the same; what the new one does not know is gone; reports everything, and
                        orders again what may have been lost with the former one
SeenInGraph             the instance is ready; a later run of this slave shall know
TimePassed              an instance that is not ready in time is stopped; old ends are forgotten
======================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rosrm.core.model import (
    RESOURCE_SLOTS,
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    RestartPolicy,
)

#: Seconds for which the end of an instance is kept for a master that did not hear of it.
REMEMBER_END: Final = 60.0
_SLOTS: Final = np.left_shift(np.uint32(1), np.arange(RESOURCE_SLOTS, dtype=np.uint32))
#: Orders to stop what was never heard of that are remembered.
_TOMBSTONES: Final = 10_000


@dataclass(frozen=True, slots=True)
class Awaited:
    """How an instance becomes ready by being seen in the ROS graph.

    Attributes:
        node_name: fully qualified name of its node.
        timeout: seconds that each of its runs has for it.
        seen: pid of the run that was seen; 0: none was.
    """

    node_name: str
    timeout: float
    seen: int = 0


# --- what can happen --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Registered:
    """The master took this host in.

    Attributes:
        renumbers: it has lost its journal, and gives numbers again that were given before.
    """

    epoch: int
    renumbers: bool = False


@dataclass(frozen=True, slots=True)
class MasterLost:
    """No master is heard, or another one: what ends now it may not have been told."""


@dataclass(frozen=True, slots=True)
class AssignmentsReceived:
    """The master assigned instances to this host."""

    assignments: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class LaunchRefused:
    """An instance cannot be started here."""

    instance: InstanceId
    reason: str


@dataclass(frozen=True, slots=True)
class StopOrdered:
    """The master wants an instance to end for good."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class RestartOrdered:
    """The master wants an instance to start again here."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class RestartPolicySet:
    """The master wants an instance to have another restart policy; a shadow is none any more."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class RestartPolicyRecorded:
    """The supervisor has written down which restart policy an instance has."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class ReportRequested:
    """The master wants to know of every instance."""


@dataclass(frozen=True, slots=True)
class SupervisorReported:
    """The supervisor says what became of instances."""

    statuses: tuple[InstanceStatus, ...]


@dataclass(frozen=True, slots=True)
class SupervisorReplaced:
    """Another supervisor took over, or this slave found one at its start.

    Attributes:
        statuses: all that it knows.
        awaited: what it was told to remember of instances that become ready in the ROS graph.
    """

    statuses: tuple[InstanceStatus, ...]
    awaited: Mapping[InstanceId, Awaited] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SeenInGraph:
    """This very instance, not a namesake, is in the ROS graph."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class TimePassed:
    """Nothing else happened; deadlines are looked at."""


# --- what is asked for ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Launch:
    """Have the supervisor start instances."""

    assignments: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class Stop:
    """Have the supervisor stop an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Restart:
    """Have the supervisor restart an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Amend:
    """Have the supervisor keep another restart policy; `RestartPolicyRecorded` follows."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class Settle:
    """Answer the order to set this restart policy; `refusal`: why it cannot be; "": it is."""

    instance: InstanceId
    restart: RestartPolicy
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Remember:
    """Have the supervisor keep this for a later run of this slave."""

    instance: InstanceId
    awaited: Awaited


@dataclass(frozen=True, slots=True)
class Forget:
    """Let the supervisor forget ended instances."""

    instances: tuple[InstanceId, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """Tell the master; `complete`: these are all."""

    statuses: tuple[InstanceStatus, ...]
    complete: bool = False


Command = Launch | Stop | Restart | Amend | Settle | Remember | Forget | Report


# --- the state --------------------------------------------------------------------------------


@dataclass(slots=True)
class Held:
    """One instance on this host.

    Attributes:
        status: as it was reported last.
        spec: None where this slave found it running at its own start.
        awaited: None: it is ready as soon as it runs.
        ready_by: deadline for becoming ready; None: it is ready, or does not run.
        unready: why it was stopped, where it did not become ready in time.
        unsettled: restart policies that the master has set and the supervisor has not recorded
            yet, in order.
    """

    status: InstanceStatus
    spec: ProcessSpec | None = None
    awaited: Awaited | None = None
    ready_by: float | None = None
    unready: str = ""
    unsettled: tuple[RestartPolicy, ...] = ()
    ended_at: float = 0.0


@dataclass(slots=True)
class SlaveState:
    """All that the slave's core knows.

    Attributes:
        max_processes: most that run at a time; 0: no bound.
        waiting: assignments that are started as soon as a slot is free, in order.
    """

    max_processes: int = 0
    epoch: int = 0
    registered: bool = False
    held: dict[InstanceId, Held] = field(default_factory=dict)
    waiting: dict[InstanceId, Assignment] = field(default_factory=dict)
    tombstones: dict[InstanceId, None] = field(default_factory=dict)

    def awaited_in_graph(self) -> Mapping[InstanceId, Held]:
        """Instances that become ready by being seen in the ROS graph."""
        return {instance: held for instance, held in self.held.items() if held.ready_by is not None}

    def statuses(self) -> tuple[InstanceStatus, ...]:
        """Of every instance, ended ones that are still remembered included."""
        return tuple(held.status for held in self.held.values())

    def has_slot(self) -> bool:
        """Whether one more process may run."""
        return not self.max_processes or self.live() - len(self.waiting) < self.max_processes

    def live(self) -> int:
        """How many instances have not ended."""
        return sum(not held.status.state.ended for held in self.held.values())


def under_limits(
    usage: npt.NDArray[np.float32], limit: npt.NDArray[np.float32], present: int, stale: int
) -> bool:
    """Whether a host may ask for work: every reading that has a limit is fresh and under it.

    Args:
        usage, limit: (slots,) fractions; 1 stands for no limit.
        present, stale: bit i speaks of slot i.
    """
    limited = limit < 1.0
    used = limited & ((present & _SLOTS) != 0)
    if stale & present and ((stale & _SLOTS) != 0)[used].any():
        return False
    return bool((usage < limit)[used].all())


def awaits_graph(spec: ProcessSpec) -> bool:
    """Whether an instance is ready when it is seen in the ROS graph, not as soon as it runs."""
    kind = spec.readiness.kind
    return kind == "graph" or (kind == "auto" and spec.ros)


def qualified_name(namespace: str, node_name: str) -> str:
    """A node's name with its namespace: `/robot/camera`."""
    inside = namespace.strip("/")
    return f"/{inside}/{node_name}" if inside else f"/{node_name}"


# --- handlers ---------------------------------------------------------------------------------

_Commands = list[Command]


def _registered(state: SlaveState, event: Registered, now: float) -> _Commands:
    # Not the highest that was ever heard: a master whose journal was lost begins at 1 again.
    state.epoch = event.epoch
    state.registered = True
    if event.renumbers:
        state.tombstones.clear()
    for held in state.held.values():
        held.ended_at = max(held.ended_at, now)  # told with the registration, not before
    # What has changed since the registration was sent went nowhere.
    return [Report(state.statuses(), complete=True)] if state.held else []


def _master_lost(state: SlaveState, event: MasterLost, now: float) -> _Commands:
    state.registered = False
    return []


def _assigned(state: SlaveState, event: AssignmentsReceived, now: float) -> _Commands:
    refusals = []
    for assignment in event.assignments:
        instance = assignment.instance
        if instance in state.held:
            continue  # the order came twice
        refusal = _why_not(state, assignment)
        if refusal:
            status = InstanceStatus(instance, InstanceState.REFUSED, message=refusal)
            state.held[instance] = Held(status, ended_at=now)
            _bury(state, instance)
            refusals.append(status)
            continue
        state.waiting[instance] = assignment
        state.held[instance] = _waiting(assignment)
    launches = _start_waiting(state)
    held = [state.held[one.instance].status for one in event.assignments]
    reports = refusals + [status for status in held if status.state is InstanceState.HELD]
    return [*launches, Report(tuple(reports))] if reports else launches


def _waiting(assignment: Assignment) -> Held:
    spec = assignment.spec
    awaited = None
    if awaits_graph(spec):
        name = qualified_name(spec.namespace, assignment.node_name)
        awaited = Awaited(name, spec.readiness.timeout)
    status = InstanceStatus(
        assignment.instance, InstanceState.HELD, message="waits for a free slot there"
    )
    return Held(status, spec, awaited)


def _start_waiting(state: SlaveState) -> _Commands:
    """Launch what waits, as far as there are slots."""
    launches = []
    while state.waiting and state.has_slot():
        instance = next(iter(state.waiting))
        launches.append(state.waiting.pop(instance))
        state.held[instance].status = InstanceStatus(instance, InstanceState.STARTING)
    return [Launch(tuple(launches))] if launches else []


def _why_not(state: SlaveState, assignment: Assignment) -> str:
    if assignment.epoch < state.epoch:
        return f"assigned in epoch {assignment.epoch}, this is epoch {state.epoch}"
    if assignment.instance in state.tombstones:
        return "it was stopped or refused here before this order came"
    return ""


def _launch_refused(state: SlaveState, event: LaunchRefused, now: float) -> _Commands:
    held = state.held[event.instance]
    held.status = InstanceStatus(event.instance, InstanceState.REFUSED, message=event.reason)
    held.ready_by, held.ended_at = None, now
    _bury(state, event.instance)
    return [*_start_waiting(state), Report((held.status,))]


def _stop_ordered(state: SlaveState, event: StopOrdered, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is not None and held.status.state.ended:
        return [Report((held.status,))]
    if held is not None and event.instance not in state.waiting:
        return [Stop(event.instance)]
    state.waiting.pop(event.instance, None)
    _bury(state, event.instance)
    status = InstanceStatus(
        event.instance, InstanceState.REFUSED, message="it was stopped before it was started"
    )
    state.held[event.instance] = Held(status, ended_at=now)
    return [Report((status,))]


def _bury(state: SlaveState, instance: InstanceId) -> None:
    state.tombstones[instance] = None
    while len(state.tombstones) > _TOMBSTONES:
        del state.tombstones[next(iter(state.tombstones))]


def _restart_ordered(state: SlaveState, event: RestartOrdered, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None or held.status.state.ended:
        return [] if held is None else [Report((held.status,))]
    if event.instance in state.waiting:
        return []  # it starts as soon as it can
    held.ready_by, held.unready = None, ""
    return [Restart(event.instance)]


def _restart_policy_set(state: SlaveState, event: RestartPolicySet, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None:
        return [_not_held(event)]
    if held.status.state.ended:
        return [Report((held.status,)), Settle(event.instance, event.restart)]
    waiting = state.waiting.get(event.instance)
    if waiting is not None:  # nobody but this slave knows of it yet
        spec = replace(waiting.spec, restart=event.restart)
        state.waiting[event.instance] = replace(waiting, spec=spec, shadow=False)
        return [Report((held.status,)), Settle(event.instance, event.restart)]
    held.unsettled += (event.restart,)
    return [Amend(event.instance, event.restart)]


def _not_held(order: RestartPolicySet) -> Settle:
    never = f"{order.instance} is not known here: it never ran on this host, or ended long ago"
    return Settle(order.instance, order.restart, never)


def _restart_policy_recorded(
    state: SlaveState, event: RestartPolicyRecorded, now: float
) -> _Commands:
    held = state.held.get(event.instance)
    if held is None:
        return [Settle(event.instance, event.restart)]
    if event.restart in held.unsettled:
        at = held.unsettled.index(event.restart)
        held.unsettled = held.unsettled[:at] + held.unsettled[at + 1 :]
    return [Report((held.status,)), Settle(event.instance, event.restart)]


def _report_requested(state: SlaveState, event: ReportRequested, now: float) -> _Commands:
    return [Report(state.statuses(), complete=True)]


def _supervisor_reported(state: SlaveState, event: SupervisorReported, now: float) -> _Commands:
    changed = [
        status
        for reported in event.statuses
        if (status := _follow(state, reported, now)) is not None
    ]
    # The next one first: the master hears of an end soon enough.
    return [*_start_waiting(state), *([Report(tuple(changed))] if changed else [])]


def _supervisor_replaced(state: SlaveState, event: SupervisorReplaced, now: float) -> _Commands:
    known = {status.instance for status in event.statuses}
    again: _Commands = []
    for instance, held in list(state.held.items()):
        lost = instance not in known and instance not in state.waiting
        if lost and not held.status.state.ended:
            del state.held[instance]
            _bury(state, instance)
        again += [
            _amend_again(RestartPolicySet(instance, restart), held, lost=lost)
            for restart in held.unsettled
        ]
    for status in event.statuses:
        _follow(state, status, now, event.awaited.get(status.instance))
    return [*again, *_start_waiting(state), Report(state.statuses(), complete=True)]


def _amend_again(order: RestartPolicySet, held: Held, *, lost: bool) -> Command:
    """What was ordered may have been lost with the supervisor."""
    if held.status.state.ended:
        return Settle(order.instance, order.restart)
    return _not_held(order) if lost else Amend(order.instance, order.restart)


def _follow(
    state: SlaveState, reported: InstanceStatus, now: float, awaited: Awaited | None = None
) -> InstanceStatus | None:
    """Take over what the supervisor says; None: that is known."""
    held = state.held.get(reported.instance)
    if held is None:
        held = state.held[reported.instance] = Held(reported, awaited=awaited)
        if reported.state is InstanceState.RUNNING:
            held.status = _running(held, reported, now)
    elif reported.state is InstanceState.RUNNING:
        if held.status.state is InstanceState.READY and held.status.pid == reported.pid:
            return None
        held.status = _running(held, reported, now)
    else:
        held.ready_by = None
        held.status = _with_unready(held, reported)
    if held.status.state.ended:
        held.ended_at = now
        _bury(state, reported.instance)
    return held.status


def _running(held: Held, reported: InstanceStatus, now: float) -> InstanceStatus:
    """A new run: ready at once, or to be seen in the graph first."""
    if held.awaited is None or held.awaited.seen == reported.pid:
        return replace(reported, state=InstanceState.READY)
    held.ready_by = now + held.awaited.timeout
    return reported


def _with_unready(held: Held, reported: InstanceStatus) -> InstanceStatus:
    if not held.unready or not reported.state.ended:
        return reported
    return replace(reported, state=InstanceState.FAILED, message=held.unready)


def _seen(state: SlaveState, event: SeenInGraph, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None or held.ready_by is None or held.awaited is None:
        return []
    held.ready_by = None
    held.status = replace(held.status, state=InstanceState.READY)
    held.awaited = replace(held.awaited, seen=held.status.pid)
    return [Remember(event.instance, held.awaited), Report((held.status,))]


def _may_be_forgotten(state: SlaveState, held: Held, now: float) -> bool:
    return state.registered and now - held.ended_at >= REMEMBER_END


def _time_passed(state: SlaveState, event: TimePassed, now: float) -> _Commands:
    commands: _Commands = []
    forgotten = []
    for instance, held in state.held.items():
        awaited = held.awaited
        if held.ready_by is not None and now >= held.ready_by and awaited is not None:
            held.ready_by = None
            held.unready = (
                f"not ready within {awaited.timeout:g} s: no node {awaited.node_name} of "
                f"this instance was seen in the ROS graph"
            )
            commands.append(Stop(instance))
        elif held.status.state.ended and _may_be_forgotten(state, held, now):
            forgotten.append(instance)
    if forgotten:
        for instance in forgotten:
            held = state.held.pop(instance)
            commands += [Settle(instance, restart) for restart in held.unsettled]
        commands.append(Forget(tuple(forgotten)))
    return commands


_Handler = Callable[[SlaveState, Any, float], _Commands]

#: The transition table.
HANDLERS: Final[Mapping[type, _Handler]] = MappingProxyType(
    {
        Registered: _registered,
        MasterLost: _master_lost,
        AssignmentsReceived: _assigned,
        LaunchRefused: _launch_refused,
        StopOrdered: _stop_ordered,
        RestartOrdered: _restart_ordered,
        RestartPolicySet: _restart_policy_set,
        RestartPolicyRecorded: _restart_policy_recorded,
        ReportRequested: _report_requested,
        SupervisorReported: _supervisor_reported,
        SupervisorReplaced: _supervisor_replaced,
        SeenInGraph: _seen,
        TimePassed: _time_passed,
    }
)

Event = (
    Registered
    | MasterLost
    | AssignmentsReceived
    | LaunchRefused
    | StopOrdered
    | RestartOrdered
    | RestartPolicySet
    | RestartPolicyRecorded
    | ReportRequested
    | SupervisorReported
    | SupervisorReplaced
    | SeenInGraph
    | TimePassed
)


def step(state: SlaveState, event: Event, now: float) -> Sequence[Command]:
    """Take one event in.

    Args:
        state: changed in place.
        event: what happened.
        now: seconds by the slave's monotonic clock; never less than before.
    """
    return HANDLERS[type(event)](state, event, now)


def step_all(state: SlaveState, events: Iterable[Event], now: float) -> list[Command]:
    """Take several events in, in order."""
    return [command for event in events for command in step(state, event, now)]
