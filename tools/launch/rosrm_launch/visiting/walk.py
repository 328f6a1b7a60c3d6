"""Walk over the entities of a launch file, in the order in which `launch` would take them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from ament_index_python.packages import get_packages_with_prefixes
from launch import actions as launched
from launch.action import Action
from launch.actions.execute_local import ExecuteLocal
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch_ros import actions as ros
from launch_ros.actions.lifecycle_transition import LifecycleTransition
from launch_ros.actions.ros_timer import ROSTimer

from rosrm_launch.model import LaunchModel
from rosrm_launch.visiting import (
    arguments,
    components,
    environment,
    events,
    processes,
    replacements,
    transitions,
)
from rosrm_launch.visiting.state import Deferred, Visit, hidden


def resolved(file: str, given: Mapping[str, str]) -> LaunchModel:
    """Return the processes of a launch file with these arguments.

    Raises:
        BadArguments: an argument is missing or unknown.
        Exception: whatever the launch file raises.
    """
    visit = Visit(file, given)
    replacements.replace_methods(visit)
    source = AnyLaunchDescriptionSource(visit.root)
    arguments.check_required(visit, source.get_launch_description(visit.context))
    _entity(visit, launched.IncludeLaunchDescription(source, launch_arguments=list(given.items())))
    _all_deferred(visit)
    arguments.check_known(visit)
    return _model(visit)


def _all_deferred(visit: Visit) -> None:
    """Visit what the file defers until an event, and all that this defers in turn."""
    waiting = 0
    while waiting < len(visit.deferred):
        deferred = visit.deferred.popleft()
        trigger = deferred.trigger()
        if trigger is None:  # the process of this event may come from another deferred action
            visit.deferred.append(deferred)
            waiting += 1
            continue
        waiting = 0
        visit.trigger, visit.file = trigger, deferred.file
        _deferred(visit, deferred)


def _deferred(visit: Visit, deferred: Deferred) -> None:
    context = visit.context
    context._push_locals()  # noqa: SLF001 - as its service
    context.extend_locals({**deferred.variables, "event": events.UnknownEvent()})
    for entity in deferred.entities:
        _entity(visit, entity)
    context._pop_locals()  # noqa: SLF001


def _entity(visit: Visit, entity: Any) -> None:
    """Visit an entity and all that results from it."""
    if not isinstance(entity, Action):
        for inner in entity.visit(visit.context) or ():
            _entity(visit, inner)
        return
    try:
        if entity.condition is None or entity.condition.evaluate(visit.context):
            _action(visit, entity)
    except events.EventNeeded as reason:
        name = hidden(entity, ros.Node, "node_name")
        title = f"{type(entity).__name__} {name}" if isinstance(name, str) else ""
        visit.omit(entity, str(reason), title)


def _action(visit: Visit, action: Any) -> None:
    for kind, special in _SPECIAL:
        if isinstance(action, kind):
            special(visit, action)
            return
    for inner in action.execute(visit.context) or ():
        _entity(visit, inner)


def _include(visit: Visit, action: Any) -> None:
    outer = visit.file
    visit.context._push_locals()  # noqa: SLF001 - as its service
    inner = action.execute(visit.context)
    visit.file = str(Path(action.launch_description_source.location).absolute())
    for entity in inner:
        _entity(visit, entity)
    visit.context._pop_locals()  # noqa: SLF001
    visit.file = outer


def _refused(reason: str) -> Callable[[Visit, Any], None]:
    return lambda visit, action: visit.omit(action, reason)


#: Actions that are not executed as in launch; the first fitting class counts.
_SPECIAL: Final[tuple[tuple[Any, Callable[[Visit, Any], None]], ...]] = (
    (ros.LoadComposableNodes, components.visit_load),
    (ros.ComposableNodeContainer, components.visit_container),
    (ros.Node, processes.visit_node),
    (ExecuteLocal, processes.visit_command),
    (launched.SetEnvironmentVariable, environment.visit_set),
    (launched.AppendEnvironmentVariable, environment.visit_append),
    (launched.PushEnvironment, environment.visit_scope),
    (launched.PopEnvironment, environment.visit_scope),
    (launched.ResetEnvironment, environment.visit_scope),
    (ros.SetROSLogDir, environment.visit_log_folder),
    (launched.RegisterEventHandler, lambda v, it: events.visit_handler(v, it.event_handler)),
    (launched.UnregisterEventHandler, _refused("rosrm has no handlers")),
    # For the node of launch itself, which would be made here.
    (ros.SetUseSimTime, lambda *_: None),
    (ROSTimer, _refused("simulated time is not known to rosrm")),
    (launched.TimerAction, events.visit_timer),
    (launched.LogInfo, events.visit_message),
    (LifecycleTransition, transitions.visit_transition),
    (launched.EmitEvent, lambda v, it: events.emit(v, it.event, it)),
    (launched.DeclareLaunchArgument, arguments.declare),
    (launched.IncludeLaunchDescription, _include),
    (launched.OpaqueCoroutine, _refused("a coroutine can do anything")),
)


def _model(visit: Visit) -> LaunchModel:
    """Return what was found, with the packages that occur in it."""
    found = LaunchModel(
        file=visit.root, arguments=list(visit.arguments.values()), processes=visit.processes,
        loads=visit.loads, transitions=visit.transitions, omissions=visit.omissions,
        notes=list(visit.notes),
    )  # fmt: skip
    text = found.model_dump_json()
    packages = {
        name: prefix
        for name, prefix in get_packages_with_prefixes().items()
        if f"{prefix}/share/{name}" in text or f"{prefix}/lib/{name}" in text
    }
    return found.model_copy(update={"packages": packages})
