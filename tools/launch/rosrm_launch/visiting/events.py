"""Timers, handlers of events, and events that a launch file emits itself."""

from __future__ import annotations

from typing import Any, Final, Literal

from launch import event_handlers as handlers
from launch.action import Action
from launch.actions.execute_local import ExecuteLocal
from launch.event_handlers.on_action_event_base import OnActionEventBase
from launch.events import Shutdown
from launch.utilities.type_utils import perform_typed_substitution
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState

from rosrm_launch.model import Wait
from rosrm_launch.visiting import transitions
from rosrm_launch.visiting.state import Trigger, Visit, hidden

#: Handlers with a counterpart. The execution of a process is complete when it has exited.
_EVENTS: Final[dict[type, Literal["started", "exited"]]] = {
    handlers.OnProcessStart: "started",
    handlers.OnProcessExit: "exited",
    handlers.OnExecutionComplete: "exited",
}


class EventNeeded(Exception):
    """An action reads the event after which it happens, which is not known while resolving."""


class UnknownEvent:
    """Event in the place of that which a deferred action could read in launch."""

    def __getattr__(self, name: str) -> Any:
        raise EventNeeded(f"it reads {name!r} of an event")


def visit_timer(visit: Visit, action: Any) -> None:
    """Defer the actions of a timer."""
    period = perform_typed_substitution(visit.context, action.period, float)
    trigger = Trigger(visit.trigger.waits, visit.trigger.delay + period)
    visit.defer(list(action.actions), lambda: trigger)


def visit_message(visit: Visit, action: Any) -> None:
    """Print a message, unless it is due later."""
    if visit.trigger == Trigger():
        action.execute(visit.context)
    else:
        visit.note("LogInfo: messages at events and timers are not printed")


def visit_handler(visit: Visit, handler: Any) -> None:
    """Defer the actions of a handler of events."""
    if type(handler) is OnStateTransition and transitions.comes_up(handler):
        # A lifecycle node whose host brings it to a state has started when it is there.
        node = transitions.target_of(handler)
        follow(visit, handler, handler.entities, "started", node)
        return
    event = _EVENTS.get(type(handler))
    if event is None:
        visit.omit(handler, "it and its actions have no counterpart in rosrm")
        return
    target = hidden(handler, OnActionEventBase, "action_matcher")
    entities = hidden(handler, OnActionEventBase, "actions_on_event")
    if isinstance(target, ExecuteLocal):
        entities = entities or hidden(handler, OnActionEventBase, "on_event")
        follow(visit, handler, entities, event, target)
    elif isinstance(target, Action):
        visit.omit(handler, f"its event is of a {type(target).__name__}, not of a process")
    else:
        visit.omit(handler, "it is for all processes, or for those that its Python code chooses")


def follow(
    visit: Visit, action: Any, entities: Any, event: Literal["started", "exited"], target: Any,
    title: str = "",
) -> None:  # fmt: skip
    """Defer the actions that follow an event of a process.

    Args:
        visit: in which they are found.
        action: to which they belong; `title` names it in a message.
        entities: one of them, or several, or a function.
        event: of the process.
        target: action of the process.
    """
    if callable(entities) and not isinstance(entities, Action):
        visit.omit(action, "it calls a function of Python at the event", title)
        return

    def trigger() -> Trigger | None:
        number = visit.numbers.get(target)
        return None if number is None else Trigger((Wait(process=number, event=event),))

    visit.defer(list(entities) if isinstance(entities, (list, tuple)) else [entities], trigger)


def emit(visit: Visit, event: Any, action: Any = None) -> None:
    """Record what an event of the file changes: the state of lifecycle nodes, or the end of all."""
    if isinstance(event, ChangeState):
        transitions.visit_change(visit, event)
    elif isinstance(event, Shutdown):
        _shut_down(visit, action or event)
    else:
        visit.omit(event, "rosrm has no events", f"EmitEvent({type(event).__name__})")


def _shut_down(visit: Visit, action: Any) -> None:
    """Record that the end of the process after which this happens ends all."""
    waits = visit.trigger.waits
    if len(waits) != 1 or waits[0].event != "exited" or visit.trigger.delay:
        visit.omit(action, "only the end of a process can end the others")
        return
    number = waits[0].process
    ends = visit.processes[number].model_copy(update={"ends_all": True})
    visit.processes[number] = ends
