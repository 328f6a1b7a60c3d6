"""Lifecycle nodes on the way to the state that their spec requires.

The slave reads the state of a node and requests one transition after the other until the node has
reached its goal. The state decides, not the history: so a node that a former run of this slave has
configured, or that has activated itself, is not configured again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Final

from rosrm.core.slave import commands, events
from rosrm.core.slave.health import resolve
from rosrm.core.slave.state import HeldInstance, Steering
from rosrm.core.slave.steps import NOTHING, Step
from rosrm.core.slave.watches import ManagedLifecycle, Transition
from rosrm.model.orders import ENDED, NOT_REACHED, UNKNOWN
from rosrm.model.values import Assignment, InstanceState, LifecycleGoal

#: Seconds between two requests for the state of a node.
READ_PERIOD: Final = 0.2
#: State and goal to the next transition.
_NEXT: Final[Mapping[tuple[str, str], Transition]] = MappingProxyType(
    {
        ("unconfigured", "inactive"): "configure",
        ("unconfigured", "active"): "configure",
        ("inactive", "active"): "activate",
        ("active", "inactive"): "deactivate",
    }
)
#: State after each transition.
STATE_AFTER: Final[Mapping[Transition, str]] = MappingProxyType(
    {"configure": "inactive", "activate": "active", "deactivate": "inactive"}
)
#: State that no transition leaves.
_FINAL: Final = "finalized"
_SCHEME: Final = "rosservice://"


def managed(assignment: Assignment) -> ManagedLifecycle | None:
    """Return the goal of an instance's node; None: the slave does not change its state."""
    spec = assignment.spec
    policy, node = spec.lifecycle, assignment.node_name or spec.node
    if not policy.is_managed:
        return None
    get_state, change_state = (
        resolve(f"~/{service}", spec.namespace, node, spec.remappings, _SCHEME)
        for service in ("get_state", "change_state")
    )
    goal: LifecycleGoal = "active"
    if assignment.inactive or policy.autostart == "inactive":
        goal = "inactive"
    return ManagedLifecycle(goal, get_state, change_state, policy.timeout)


def ordered(
    held: HeldInstance | None, event: events.LifecycleOrdered, now: float, *, waits: bool
) -> list[commands.Command]:
    """Change the goal of a node; the answer follows when the node has reached it.

    The health checks are paused while the node is inactive, because it may be silent.

    Args:
        waits: the instance waits for its start, and the supervisor does not know it.
    """
    if held is None:
        why = f"{event.instance} is not known here"
        return [commands.SettleLifecycle(event.instance, event.goal, why, UNKNOWN)]
    if held.status.state.ended:
        ended = commands.SettleLifecycle(event.instance, event.goal, "it has ended", ENDED)
        return [commands.Report((held.status,)), ended]
    if held.lifecycle is None:
        why = "its host does not change the lifecycle state of its node"
        return [commands.SettleLifecycle(event.instance, event.goal, why)]
    answers = settled(held, "another state was ordered") if held.ordered != event.goal else []
    held.ordered = event.goal
    if held.lifecycle.goal != event.goal:
        held.lifecycle = replace(held.lifecycle, goal=event.goal)
        if held.watch is not None:
            held.watch, held.judgement = replace(held.watch, paused=event.goal != "active"), None
        answers += [] if waits else [commands.Remember(event.instance, held.memo)]
    if held.status.state is InstanceState.READY and held.steering is None:
        answers += begin(held, held.lifecycle, now).commands
    return answers


def settled(
    held: HeldInstance, refusal: str = "", code: str = NOT_REACHED
) -> list[commands.Command]:
    """Answer the order of the master, if there is one."""
    goal, held.ordered = held.ordered, None
    if goal is None:
        return []
    return [commands.SettleLifecycle(held.status.instance, goal, refusal, code)]


def begin(held: HeldInstance, lifecycle: ManagedLifecycle, now: float) -> Step:
    """Request the state of a node that is in the graph."""
    held.steering = Steering(now, now + lifecycle.timeout, now)
    return _read(held, lifecycle, now)


def state_read(held: HeldInstance, event: events.LifecycleStateRead, now: float) -> Step:
    """Take the state that a node reports; the answer to a transition may be lost."""
    steering, lifecycle = held.steering, held.lifecycle
    if steering is None or lifecycle is None or event.asked_at < steering.began:
        return NOTHING
    steering.state = event.state
    if steering.transition and event.state not in (STATE_AFTER[steering.transition], _FINAL):
        return NOTHING
    return _arrived(held, steering, lifecycle, now)


def transition_answered(held: HeldInstance, event: events.TransitionAnswered, now: float) -> Step:
    """Take the answer to a transition."""
    steering, lifecycle = held.steering, held.lifecycle
    if steering is None or lifecycle is None or steering.transition != event.transition:
        return NOTHING
    if not event.succeeded:
        where = f" from the state {steering.state}" if steering.state else ""
        return Step(fault=f"the lifecycle transition {event.transition}{where} failed in the node")
    steering.state = STATE_AFTER[event.transition]
    return _arrived(held, steering, lifecycle, now)


def time_passed(held: HeldInstance, now: float) -> Step:
    """Request the state of a node again, or give up at the time-out."""
    steering, lifecycle = held.steering, held.lifecycle
    if steering is None or lifecycle is None:
        return NOTHING
    if now >= steering.deadline:
        return Step(fault=_time_out(steering, lifecycle))
    if now - steering.read_at < READ_PERIOD:
        return NOTHING
    steering.read_at = now
    return _read(held, lifecycle, now)


def _arrived(
    held: HeldInstance, steering: Steering, lifecycle: ManagedLifecycle, now: float
) -> Step:
    """Request the next transition of a node in a known state; the goal may be reached."""
    steering.transition = None
    if steering.state == lifecycle.goal:
        return Step(reached=True)
    if steering.state == _FINAL:
        return Step(fault=f"its lifecycle state is {_FINAL}; {lifecycle.goal} is required")
    transition = _NEXT.get((steering.state, lifecycle.goal))
    if transition is None:  # the node is in a transition that it began itself
        return NOTHING
    steering.transition, steering.deadline = transition, now + lifecycle.timeout
    status = held.status
    change = commands.ChangeLifecycleState(status.instance, status.pid, lifecycle, transition)
    return Step((change,))


def _read(held: HeldInstance, lifecycle: ManagedLifecycle, now: float) -> Step:
    status = held.status
    return Step((commands.ReadLifecycleState(status.instance, status.pid, lifecycle, now),))


def _time_out(steering: Steering, lifecycle: ManagedLifecycle) -> str:
    limit = f"{lifecycle.timeout:g} s"
    if steering.transition:
        return f"the lifecycle transition {steering.transition} took longer than {limit}"
    if steering.state:
        return f"its lifecycle state was {steering.state} for {limit}; {lifecycle.goal} is required"
    return f"no answer from {lifecycle.get_state} within {limit}"
