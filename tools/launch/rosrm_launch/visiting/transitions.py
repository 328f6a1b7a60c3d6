"""Transitions of lifecycle nodes."""

from __future__ import annotations

from typing import Any

from launch_ros.actions.lifecycle_transition import LifecycleTransition
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState, StateTransition
from lifecycle_msgs.msg import State, TransitionEvent

from rosrm_launch.model import Transition
from rosrm_launch.visiting.state import Visit, hidden


def visit_transition(visit: Visit, action: Any) -> None:
    """Record the transitions that nodes make one after the other."""
    names = [visit.text(one) for one in hidden(action, LifecycleTransition, "lifecycle_node_names")]
    for one in hidden(action, LifecycleTransition, "transition_ids"):
        note(visit, names, int(visit.text(one)))


def visit_change(visit: Visit, event: Any) -> None:
    """Record a transition of the nodes that an event names."""
    nodes = [one for one in visit.lifecycle_nodes if event.lifecycle_node_matcher(one)]
    note(visit, [one.node_name for one in nodes], event.transition_id)


def note(visit: Visit, nodes: list[str], transition: int | str) -> None:
    """Record a transition by its number or name, such as `configure`."""
    known = str(ChangeState.valid_transitions.get(transition, transition))
    name = known.removeprefix("TRANSITION_").lower()
    visit.transitions.append(Transition(file=visit.file, nodes=nodes, transition=name))
    if visit.trigger.delay:
        visit.note(f"{name} of {', '.join(nodes)} waits for its node, and not for a timer")


def target_of(handler: Any) -> Any:
    """Return the lifecycle node of a handler; None if it has none."""
    return hidden(handler, OnStateTransition, "target_lifecycle_node")


def comes_up(handler: Any) -> bool:
    """Return True for the event that one node was configured or activated."""
    node = target_of(handler)
    return node is not None and any(
        handler.matches(StateTransition(action=node, msg=_message(start, goal)))
        for start, goal in (("configuring", "inactive"), ("activating", "active"))
    )


def _message(start: str, goal: str) -> TransitionEvent:
    """Return the message that a lifecycle node publishes at the end of a transition."""
    event = TransitionEvent(start_state=State(label=start), goal_state=State(label=goal))
    event.transition.label = "transition_success"
    return event
