"""Methods of launch that a visit replaces, so that it records, and starts nothing."""

from __future__ import annotations

import re
from typing import Any, Final

from launch.actions.execute_local import ExecuteLocal
from launch.frontend import Parser
from launch.substitutions import Command, LaunchConfiguration, TextSubstitution
from launch_ros.substitutions import ExecutableInPackage

from rosrm_launch.visiting import events
from rosrm_launch.visiting.state import Visit

#: Text of XML and YAML files that has no substitution.
_PLAIN: Final = re.compile(r"[^$\\]+")


def replace_methods(visit: Visit) -> None:
    """Replace methods of launch for the rest of this process."""
    # Each process is only prepared.
    ExecuteLocal.execute = lambda action, context: action.prepare(context)
    # The package may be on the hosts only.
    ExecutableInPackage.perform = lambda part, _: visit.text(part.executable)
    Command.perform = _noting_commands(visit, Command.perform)
    LaunchConfiguration.perform = _noting_names(visit, LaunchConfiguration.perform)
    # The parser of launch takes most of the time, also for text in which nothing is replaced.
    Parser.parse_substitution = _quick_for_plain_text(Parser.parse_substitution)
    # The Python code of a launch file may do without the actions for them.
    visit.context.register_event_handler = lambda handler, **_: events.visit_handler(visit, handler)
    visit.context.emit_event_sync = lambda event: events.emit(visit, event)


def _noting_commands(visit: Visit, perform: Any) -> Any:
    def replacement(part: Any, context: Any) -> str:
        visit.note(f"run on this machine: {visit.text(part.command):.200}")
        return str(perform(part, context))

    return replacement


def _noting_names(visit: Visit, perform: Any) -> Any:
    def replacement(part: Any, context: Any) -> str:
        visit.asked.add(visit.text(part.variable_name))
        return str(perform(part, context))

    return replacement


def _quick_for_plain_text(parse: Any) -> Any:
    def replacement(parser: Any, text: str) -> Any:
        return [TextSubstitution(text=text)] if _PLAIN.fullmatch(text) else parse(parser, text)

    return replacement
