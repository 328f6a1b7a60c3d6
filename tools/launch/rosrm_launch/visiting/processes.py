"""Processes of a launch file: its nodes and other commands, as launch would start them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from launch.actions.execute_local import ExecuteLocal
from launch_ros import actions as ros

from rosrm.wording import listed
from rosrm_launch.model import Component, Process, ProcessKind
from rosrm_launch.visiting import environment, events, transitions
from rosrm_launch.visiting.state import Visit, hidden, program_of
from rosrm_launch.words import RosArguments, existing_paths


def visit_command(visit: Visit, action: Any) -> None:
    """Record a command that is no node."""
    action.execute(visit.context)
    words = _words(action)
    if words and words[0].startswith("/") and shutil.which(Path(words[0]).name) == words[0]:
        words[0] = Path(words[0]).name  # another host may have it elsewhere
    # As the shell gets it from launch.
    command = [" ".join(words)] if action.shell else words
    _add(visit, action, kind="command", command=command, shell=action.shell)


def visit_node(visit: Visit, action: Any) -> None:
    """Record a node, which may be a lifecycle node."""
    if not isinstance(action, ros.LifecycleNode):
        add_node(visit, action, "node")
        return
    visit.lifecycle_nodes.append(action)
    add_node(visit, action, "lifecycle")
    if hidden(action, ros.LifecycleNode, "autostart"):
        transitions.note(visit, [action.node_name], "autostart")


def add_node(
    visit: Visit, action: Any, kind: ProcessKind, components: Sequence[Component] = ()
) -> None:
    """Record the process of a node or container."""
    # Not its own `execute`: that of a lifecycle node or container makes a ROS node here.
    ros.Node.execute(action, visit.context)
    package = visit.text(action.node_package)
    program, *words = _words(action)
    arguments, rules = _arguments(action, words)
    _add(
        visit, action, kind=kind, package=package,
        name=rules.names.get("__node", ""), namespace=rules.names.get("__ns", ""),
        executable=visit.text(action.node_executable) if package else "",
        command=[] if package else [program], arguments=arguments,
        parameters=rules.parameters, remappings=rules.remappings, components=list(components),
    )  # fmt: skip


def _arguments(action: Any, words: Sequence[str]) -> tuple[list[str], RosArguments]:
    """Return the arguments that the file gives a node, and those that launch_ros appends."""
    own = len(list(hidden(action, ros.Node, "arguments") or ()))
    for_ros = len(list(hidden(action, ros.Node, "ros_arguments") or ()))
    end = own + (1 + for_ros if for_ros else 0)  # `--ros-args` before them
    rules = RosArguments(words[end + 1 :])
    return [*words[:end], *rules.others], rules


def _words(action: Any) -> list[str]:
    """Return the command line of a prepared action without its prefix."""
    return list(action.process_description.final_cmd[_prefix_length(action) :])


def _prefix_length(action: Any) -> int:
    described = action.process_description
    return len(described.final_cmd) - len(described.cmd)


def _add(visit: Visit, action: Any, **fields: Any) -> None:
    """Record the process of a prepared action, and what follows its end."""
    if action in visit.numbers:
        visit.omit(action, "launch starts it only once", f"second start of {program_of(action)}")
        return
    described = action.process_description
    number = len(visit.processes)
    process = Process(
        number=number, file=visit.file, label=visit.text(described.name),
        prefix=[
            *environment.removal(visit, action), *described.final_cmd[: _prefix_length(action)]
        ],
        environment=environment.variables(visit, action),
        working_directory=described.final_cwd or "",
        respawn=bool(hidden(action, ExecuteLocal, "respawn")),
        respawn_delay=float(hidden(action, ExecuteLocal, "respawn_delay") or 0.0),
        respawn_retries=int(hidden(action, ExecuteLocal, "respawn_max_retries", -1)),
        interrupt_grace=float(visit.text(action.sigterm_timeout)),
        terminate_grace=float(visit.text(action.sigkill_timeout)),
        waits=list(visit.trigger.waits), delay=visit.trigger.delay, **fields,
    )  # fmt: skip
    paths = _without_temporary(visit, action, existing_paths(process))
    visit.processes.append(process.model_copy(update={"paths": paths}))
    visit.numbers[action] = number
    if action.emulate_tty:
        visit.note("emulate_tty: processes have no terminal; `rosrm logs` shows their output")
    on_exit = hidden(action, ExecuteLocal, "on_exit")
    if on_exit is not None:
        title = f"on_exit of {type(action).__name__}"
        events.follow(visit, action, on_exit, "exited", action, title)


def _without_temporary(visit: Visit, action: Any, paths: Sequence[str]) -> list[str]:
    """Return paths without those that the launch file has just made, which are listed."""
    temporary = [path for path in paths if Path(path).is_relative_to(tempfile.gettempdir())]
    if temporary:
        names = listed([Path(path).name for path in temporary])
        reason = f"the launch file makes {names} on this machine only"
        visit.omit(action, reason, f"temporary file of {program_of(action)}")
    return [path for path in paths if path not in temporary]
