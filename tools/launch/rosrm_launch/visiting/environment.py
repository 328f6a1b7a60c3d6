"""Environment of the processes: what a launch file sets, adds, replaces and removes."""

from __future__ import annotations

from typing import Any

from launch import actions as launched

from rosrm_launch.visiting.state import Visit, program_of

#: Variables that the resolver has only while it runs.
_OF_RESOLVER = ("ROS_LOG_DIR", "TMPDIR")


def visit_set(visit: Visit, action: Any) -> None:
    """Set a variable, which hosts get also if it has this value here anyway."""
    visit.set_variables.add(visit.text(action.name))
    action.execute(visit.context)


def visit_scope(visit: Visit, action: Any) -> None:
    """Begin or end a group, outside of which the file does not set its variables."""
    if isinstance(action, launched.PushEnvironment):
        visit.outer_variables.append(set(visit.set_variables))
    elif isinstance(action, launched.PopEnvironment):
        visit.set_variables = visit.outer_variables.pop()
    else:
        visit.set_variables = set()
    action.execute(visit.context)


def visit_append(visit: Visit, action: Any) -> None:
    """Append to a variable, whose value here may not be that of the hosts."""
    name = visit.text(action.name)
    if name in visit.before:
        visit.note(f"{name} becomes that of this machine, with what the file appends")
    visit_set(visit, action)


def visit_log_folder(visit: Visit, action: Any) -> None:
    """Set the folder of the logs of ROS."""
    if visit.text(action.log_dir).startswith("/"):
        action.execute(visit.context)
    else:
        visit.omit(action, "its path is relative to the log folder of launch")


def variables(visit: Visit, action: Any) -> dict[str, str]:
    """Return the variables that a process has beside those of its host."""
    described = action.process_description
    final = dict(described.final_env)
    if described.env is not None and _lacking(visit, final):
        title = f"environment of {program_of(action)}"
        visit.omit(action, "`env` replaces all variables; its own are added instead", title)
        return final
    added = {visit.text(name) for name, _ in described.additional_env or ()}
    # The variables of this process are no measure: SetEnvironmentVariable changes them.
    return {
        name: value for name, value in final.items()
        if name in added or name in visit.set_variables or visit.before.get(name) != value
    }  # fmt: skip


def removal(visit: Visit, action: Any) -> list[str]:
    """Return the words before a command that remove the variables which the file removes."""
    described = action.process_description
    if described.env is not None:
        return []
    lacking = _lacking(visit, described.final_env)
    return ["env", *(word for name in lacking for word in ("-u", name))] if lacking else []


def _lacking(visit: Visit, final: dict[str, str]) -> list[str]:
    return [name for name in visit.before if name not in final and name not in _OF_RESOLVER]
