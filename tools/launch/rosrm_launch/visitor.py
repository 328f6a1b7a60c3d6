"""Visit of a launch file with the real `launch`, which records processes instead of starting them.

Only this module imports `launch` and `launch_ros`. It reads attributes that they do not publish,
because neither offers a way to inspect a description.
"""

# ruff: noqa: SLF001 - see above

from __future__ import annotations

import asyncio
import os
import shutil
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ament_index_python.packages import get_packages_with_prefixes
from launch import LaunchContext
from launch import actions as launched
from launch import event_handlers as handlers
from launch.action import Action
from launch.actions.execute_local import ExecuteLocal
from launch.events import Shutdown as ShutdownEvent
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import Command
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch.utilities.type_utils import perform_typed_substitution
from launch_ros import actions as ros
from launch_ros.actions.lifecycle_transition import LifecycleTransition
from launch_ros.actions.load_composable_nodes import get_composable_node_load_request
from launch_ros.actions.ros_timer import ROSTimer
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState, StateTransition
from launch_ros.substitutions import ExecutableInPackage
from lifecycle_msgs.msg import State, TransitionEvent

from rosrm.wording import get_close_matches, listed
from rosrm_launch.model import (
    Argument,
    Component,
    LaunchModel,
    Load,
    Omission,
    Process,
    ProcessKind,
    Transition,
    Wait,
)
from rosrm_launch.words import RosArguments, existing_paths

#: Variables that launch or this process sets for itself.
_OWN_VARIABLES = ("ROS_LOG_DIR", "TMPDIR")


class BadArguments(Exception):
    """Arguments of a launch file that are missing or unknown."""


@dataclass(frozen=True)
class _Trigger:
    """Events and delay after which the visited actions happen."""

    waits: tuple[Wait, ...] = ()
    delay: float = 0.0


@dataclass
class _Deferred:
    """Actions that are visited once the rest of the file was."""

    entities: Sequence[Any]
    trigger: Callable[[], _Trigger | None]
    file: str
    variables: Mapping[str, Any]


@dataclass
class _Record:
    """All that was found so far; `numbers`: of the actions that became processes."""

    processes: list[Process] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)
    transitions: list[Transition] = field(default_factory=list)
    omissions: list[Omission] = field(default_factory=list)
    arguments: dict[str, Argument] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)
    numbers: dict[int, int] = field(default_factory=dict)


def declared(file: str) -> list[Argument]:
    """Return the arguments that a file declares, as `ros2 launch --show-args` does."""
    context = LaunchContext(noninteractive=True)
    description = AnyLaunchDescriptionSource(file).get_launch_description(context)
    found = {one.name: one for one in description.get_launch_arguments()}
    return [_argument(one, context) for one in found.values()]


def resolved(file: str, arguments: Mapping[str, str]) -> LaunchModel:
    """Return the processes of a launch file with these arguments.

    Raises:
        BadArguments: an argument is missing or unknown.
        Exception: whatever the launch file raises.
    """
    visitor = _Visitor(file, arguments)
    with visitor.recording():
        visitor.run()
    return visitor.model()


def _argument(action: Any, context: LaunchContext) -> Argument:
    default = action.default_value
    try:
        text = None if default is None else perform_substitutions(context, default)
    except Exception:  # noqa: BLE001 - it depends on other arguments
        text = "".join(part.describe() for part in default)
    return Argument(
        name=action.name, default=text, description=action.description or "",
        choices=list(action.choices or ()),
    )  # fmt: skip


class _Visitor:
    """Visits the entities of a launch file in the order in which `launch` would."""

    def __init__(self, file: str, arguments: Mapping[str, str]) -> None:
        self._root = str(Path(file).absolute())
        self._arguments = dict(arguments)
        self._before = dict(os.environ)
        self.context = LaunchContext(
            argv=[f"{name}:={value}" for name, value in arguments.items()], noninteractive=True
        )
        self.context._set_asyncio_loop(asyncio.new_event_loop())
        self.record = _Record()
        self._file = self._root
        self._trigger = _Trigger()
        self._deferred: deque[_Deferred] = deque()
        self._lifecycle_nodes: list[Any] = []
        self._special: tuple[tuple[Any, Callable[[Any], object]], ...] = (
            (ros.LoadComposableNodes, self._load),
            (ros.ComposableNodeContainer, self._container),
            (ros.Node, self._node),
            (ExecuteLocal, self._execute),
            (launched.RegisterEventHandler, self._handler),
            # For the node of launch itself, which would be made here.
            (ros.SetUseSimTime, lambda _: None),
            (ROSTimer, lambda it: self._omit(it, "simulated time is not known to rosrm")),
            (launched.TimerAction, self._timer),
            (LifecycleTransition, self._transition),
            (launched.EmitEvent, self._event),
            (launched.DeclareLaunchArgument, self._declare),
            (launched.IncludeLaunchDescription, self._include),
            (launched.OpaqueCoroutine, lambda it: self._omit(it, "a coroutine can do anything")),
            (launched.UnregisterEventHandler, lambda it: self._omit(it, "rosrm has no handlers")),
        )

    # --- the whole file -----------------------------------------------------------------------

    def run(self) -> None:
        """Visit the file, and then what it defers until an event."""
        source = AnyLaunchDescriptionSource(self._root)
        description = source.get_launch_description(self.context)
        self._check_given(description)
        include = launched.IncludeLaunchDescription(
            source, launch_arguments=list(self._arguments.items())
        )
        self.visit(include)
        waiting = 0
        while self._deferred and waiting < len(self._deferred):
            deferred = self._deferred.popleft()
            trigger = deferred.trigger()
            if trigger is None:  # the process of this event may come from another deferred action
                self._deferred.append(deferred)
                waiting += 1
                continue
            waiting = 0
            self._trigger, self._file = trigger, deferred.file
            self.context._push_locals()
            self.context.extend_locals(dict(deferred.variables))
            for entity in deferred.entities:
                self.visit(entity)
            self.context._pop_locals()
        unknown = [name for name in self._arguments if name not in self.record.arguments]
        if unknown:
            raise BadArguments(_unknown(unknown, list(self.record.arguments)))

    def _check_given(self, description: Any) -> None:
        missing = [
            one for one in description.get_launch_arguments()
            if one.default_value is None and not one._conditionally_included
            and one.name not in self._arguments
        ]  # fmt: skip
        if missing:
            wanted = listed([f"{one.name} ({one.description})" for one in missing])
            raise BadArguments(
                f"required: {wanted}; write {missing[0].name}:=VALUE. `--show-args` lists all"
            )

    def model(self) -> LaunchModel:
        """Return what was found."""
        record = self.record
        found = LaunchModel(
            file=self._root, arguments=list(record.arguments.values()),
            processes=record.processes, loads=record.loads, transitions=record.transitions,
            omissions=record.omissions, notes=list(record.notes),
        )  # fmt: skip
        text = found.model_dump_json()
        packages = {
            name: prefix
            for name, prefix in get_packages_with_prefixes().items()
            if f"{prefix}/share/{name}" in text or f"{prefix}/lib/{name}" in text
        }
        return found.model_copy(update={"packages": packages})

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Let processes be prepared and recorded instead of started, within this context."""
        execute, find, perform = ExecuteLocal.execute, ExecutableInPackage.perform, Command.perform

        def in_package(it: Any, context: LaunchContext) -> str:
            # The package may be on the hosts only.
            return str(perform_substitutions(context, it.executable))

        def command(it: Any, context: LaunchContext) -> str:
            words = perform_substitutions(context, it.command)
            self.record.notes[f"{self._file}: run on this machine: {words:.200}"] = None
            return str(perform(it, context))

        ExecuteLocal.execute = lambda it, context: it.prepare(context)
        ExecutableInPackage.perform, Command.perform = in_package, command
        try:
            yield
        finally:
            ExecuteLocal.execute = execute
            ExecutableInPackage.perform, Command.perform = find, perform

    # --- single entities ----------------------------------------------------------------------

    def visit(self, entity: Any) -> None:
        """Visit an entity and all that results from it."""
        if not isinstance(entity, Action):
            for inner in entity.visit(self.context) or ():
                self.visit(inner)
            return
        if entity.condition is not None and not entity.condition.evaluate(self.context):
            return
        for kind, special in self._special:
            if isinstance(entity, kind):
                special(entity)
                return
        for inner in entity.execute(self.context) or ():
            self.visit(inner)

    def _omit(self, action: Any, reason: str, what: str = "") -> None:
        text = what or type(action).__name__
        self.record.omissions.append(Omission(file=self._file, action=text, reason=reason))

    def _declare(self, action: Any) -> None:
        self.record.arguments.setdefault(action.name, _argument(action, self.context))
        action.execute(self.context)

    def _include(self, action: Any) -> None:
        outer = self._file
        self.context._push_locals()
        inner = action.execute(self.context)
        self._file = str(Path(action.launch_description_source.location).absolute())
        for entity in inner:
            self.visit(entity)
        self.context._pop_locals()
        self._file = outer

    # --- processes ----------------------------------------------------------------------------

    def _container(self, action: Any) -> None:
        described = action._ComposableNodeContainer__composable_node_descriptions or ()
        components = self._components(described)
        self._node(action, kind="container", components=components)

    def _load(self, action: Any) -> None:
        target = action._LoadComposableNodes__target_container
        if isinstance(target, ros.ComposableNodeContainer):
            name = target.node_name
        else:
            parts = normalize_to_list_of_substitutions(target)
            name = perform_substitutions(self.context, parts)
        described = action._LoadComposableNodes__composable_node_descriptions
        load = Load(file=self._file, container=name, components=self._components(described))
        self.record.loads.append(load)

    def _components(self, described: Sequence[Any]) -> list[Component]:
        """Return the components whose conditions hold, as launch would request them."""
        requests = (get_composable_node_load_request(one, self.context) for one in described)
        return [
            Component(
                package=one.package_name, plugin=one.plugin_name, name=one.node_name,
                namespace=one.node_namespace, parameters=_values(one.parameters),
                remappings=[tuple(rule.split(":=", 1)) for rule in one.remap_rules],
                arguments=_values(one.extra_arguments),
            )
            for one in requests
            if one is not None
        ]  # fmt: skip

    def _text(self, given: Any) -> str:
        if given is None:
            return ""
        parts = normalize_to_list_of_substitutions(given)
        return str(perform_substitutions(self.context, parts))

    def _node(
        self, action: Any, kind: ProcessKind = "node", components: Sequence[Component] = ()
    ) -> None:
        if kind == "node" and isinstance(action, ros.LifecycleNode):
            kind = "lifecycle"
            self._lifecycle_nodes.append(action)
        # Not its own `execute`: that of a lifecycle node or container makes a ROS node here.
        ros.Node.execute(action, self.context)
        package = self._text(action.node_package)
        words = self._words(action)
        own = [*(action._Node__arguments or ())]
        arguments, rest = words[1 : 1 + len(own)], words[1 + len(own) :]
        for_ros = len(list(action._Node__ros_arguments or ()))
        if for_ros:
            arguments += rest[: 1 + for_ros]
            rest = rest[1 + for_ros :]
        rules = RosArguments(rest[1:])
        arguments += rules.others
        name, namespace = rules.names.get("__node", ""), rules.names.get("__ns", "")
        self._add(
            action, kind=kind, name=name, namespace=namespace, package=package,
            executable=self._text(action.node_executable) if package else "",
            command=[] if package else [words[0]], arguments=arguments,
            parameters=rules.parameters, remappings=rules.remappings,
            components=list(components),
        )  # fmt: skip
        if getattr(action, "_LifecycleNode__autostart", False):
            self._note_transition([action.node_name], "autostart")

    def _execute(self, action: Any) -> None:
        action.execute(self.context)
        words = self._words(action)
        if words and words[0].startswith("/") and shutil.which(Path(words[0]).name) == words[0]:
            words[0] = Path(words[0]).name  # another host may have it elsewhere
        # As the shell gets it from launch.
        command = [" ".join(words)] if action.shell else words
        self._add(action, kind="command", command=command, shell=action.shell)

    def _words(self, action: Any) -> list[str]:
        """Return the command line of a prepared action without its prefix."""
        return list(action.process_description.final_cmd[self._prefix_length(action) :])

    def _prefix_length(self, action: Any) -> int:
        described = action.process_description
        return len(described.final_cmd) - len(described.cmd)

    def _add(self, action: Any, **fields: Any) -> None:
        described, private = action.process_description, "_ExecuteLocal__"
        label = getattr(described, "name", None)
        number = len(self.record.processes)
        process = Process(
            number=number, file=self._file,
            label=self._text(label), prefix=described.final_cmd[: self._prefix_length(action)],
            environment=self._environment(action), working_directory=described.final_cwd or "",
            respawn=bool(getattr(action, f"{private}respawn")),
            respawn_delay=float(getattr(action, f"{private}respawn_delay") or 0.0),
            respawn_retries=int(getattr(action, f"{private}respawn_max_retries", -1)),
            interrupt_grace=float(self._text(action.sigterm_timeout)),
            terminate_grace=float(self._text(action.sigkill_timeout)),
            waits=list(self._trigger.waits), delay=self._trigger.delay, **fields,
        )  # fmt: skip
        process = process.model_copy(update={"paths": existing_paths(process)})
        self.record.processes.append(process)
        self.record.numbers[id(action)] = number
        on_exit = getattr(action, f"{private}on_exit", None)
        if on_exit is not None:
            self._on_event(action, on_exit, "exited", action)

    def _environment(self, action: Any) -> dict[str, str]:
        final = action.process_description.final_env
        title = f"environment of {action.process_description.final_name.rpartition('-')[0]}"
        # The variables of this process, because SetEnvironmentVariable changes them.
        changed = {
            name: value for name, value in final.items()
            if self._before.get(name) != value and name not in _OWN_VARIABLES
        }  # fmt: skip
        lacking = [name for name in self._before if name not in final]
        if action.process_description.env is not None:
            self._omit(action, "`env` replaces all variables; its own are added instead", title)
        elif lacking:
            self._omit(action, f"{listed(lacking)} cannot be removed", title)
        return changed

    # --- events -------------------------------------------------------------------------------

    def _timer(self, action: Any) -> None:
        period = perform_typed_substitution(self.context, action.period, float)
        trigger = _Trigger(self._trigger.waits, self._trigger.delay + period)
        self._defer(list(action.actions), lambda: trigger)

    def _defer(self, entities: Sequence[Any], trigger: Callable[[], _Trigger | None]) -> None:
        variables = dict(self.context.get_locals_as_dict())
        self._deferred.append(_Deferred(entities, trigger, self._file, variables))

    def _handler(self, action: Any) -> None:
        handler = action.event_handler
        if type(handler) is OnStateTransition and self._comes_up(handler):
            # A lifecycle node whose host brings it to a state has started when it is there.
            node = handler._OnStateTransition__target_lifecycle_node
            self._on_event(handler, handler.entities, "started", node)
            return
        kinds = ((handlers.OnProcessExit, "exited"), (handlers.OnProcessStart, "started"))
        event = next((word for kind, word in kinds if type(handler) is kind), "")
        if not event:
            self._omit(handler, "it and its actions have no counterpart in rosrm")
            return
        private = "_OnActionEventBase__"
        target = getattr(handler, f"{private}action_matcher")
        entities = getattr(handler, f"{private}actions_on_event")
        if not isinstance(target, Action):
            self._omit(handler, "it is for processes that only its Python code knows")
            return
        self._on_event(handler, entities or getattr(handler, f"{private}on_event"), event, target)

    def _comes_up(self, handler: Any) -> bool:
        """Return True for the event that one node was configured or activated."""
        node = handler._OnStateTransition__target_lifecycle_node
        return node is not None and any(
            handler.matches(StateTransition(action=node, msg=_transition(start, goal)))
            for start, goal in (("configuring", "inactive"), ("activating", "active"))
        )

    def _on_event(self, what: Any, entities: Any, event: str, target: Any) -> None:
        """Defer the actions that follow an event of a process."""
        name = f"on_exit of {type(what).__name__}" if what is target else type(what).__name__
        if callable(entities) and not isinstance(entities, Action):
            self._omit(what, "it calls a function of Python at the event", name)
            return
        several = list(entities) if isinstance(entities, (list, tuple)) else [entities]

        def trigger() -> _Trigger | None:
            number = self.record.numbers.get(id(target))
            return None if number is None else _Trigger((Wait(process=number, event=event),))  # type: ignore[arg-type]

        self._defer(several, trigger)

    def _event(self, action: Any) -> None:
        event = action.event
        if isinstance(event, ChangeState):
            nodes = [one for one in self._lifecycle_nodes if event.lifecycle_node_matcher(one)]
            self._note_transition([one.node_name for one in nodes], event.transition_id)
        elif isinstance(event, ShutdownEvent):
            self._shut_down(action)
        else:
            self._omit(action, "rosrm has no events", f"EmitEvent({type(event).__name__})")

    def _shut_down(self, action: Any) -> None:
        waits = self._trigger.waits
        if len(waits) != 1 or waits[0].event != "exited" or self._trigger.delay:
            self._omit(action, "only the end of a process can end the others")
            return
        number = waits[0].process
        ends = self.record.processes[number].model_copy(update={"ends_all": True})
        self.record.processes[number] = ends

    def _transition(self, action: Any) -> None:
        private = "_LifecycleTransition__"
        names = [self._text(one) for one in getattr(action, f"{private}lifecycle_node_names")]
        ids = [int(self._text(one)) for one in getattr(action, f"{private}transition_ids")]
        for number in ids:
            self._note_transition(names, number)

    def _note_transition(self, nodes: list[str], transition: int | str) -> None:
        """Note a transition by its number or name, as `configure`."""
        known = str(ChangeState.valid_transitions.get(transition, transition))
        name = known.removeprefix("TRANSITION_").lower()
        found = Transition(file=self._file, nodes=nodes, transition=name)
        self.record.transitions.append(found)


def _transition(start: str, goal: str) -> TransitionEvent:
    """Return the message that a lifecycle node publishes at the end of a transition."""
    event = TransitionEvent(start_state=State(label=start), goal_state=State(label=goal))
    event.transition.label = "transition_success"
    return event


def _unknown(names: Sequence[str], known: Sequence[str]) -> str:
    close = [near for name in names for near in get_close_matches(name, list(known), 1)]
    hint = f"; did you mean {listed(close, 'or')}?" if close else ""
    own = listed(list(known)) if known else "none"
    return f"it declares no argument {listed(list(names))}{hint or '.'} Its arguments: {own}"


#: Field of a parameter's value, by its type.
_FIELDS: Final = (
    "", "bool_value", "integer_value", "double_value", "string_value", "byte_array_value",
    "bool_array_value", "integer_array_value", "double_array_value", "string_array_value",
)  # fmt: skip


def _values(parameters: Sequence[Any]) -> dict[str, Any]:
    """Return ROS parameters in messages as values of JSON."""
    found = {}
    for one in parameters:
        value = getattr(one.value, _FIELDS[one.value.type])
        found[one.name] = list(value) if isinstance(value, array) else value
    return found
