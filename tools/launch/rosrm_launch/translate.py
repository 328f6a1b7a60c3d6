"""Translation of a resolved launch file into a work file with an application; pure functions."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, Final

from rosrm.errors import ConfigError
from rosrm.model.description_checks import is_node_name
from rosrm.model.parameters import SECTION, merged_parameters
from rosrm.model.placeholders import variable_fault
from rosrm.model.values import ALL_NODES, KEEP_NAME, ParameterSource, qualified_name
from rosrm.wording import listed
from rosrm_launch.model import Component, LaunchModel, Load, Omission, Process
from rosrm_launch.package_paths import PackagePaths

#: Restarts of a process that launch starts again without end.
_ENDLESS: Final = 2**31 - 1
#: Most processes that one start order names.
_MOST_AWAITED: Final = 256
#: Transition of a lifecycle node to the state to which its host brings it.
_GOALS: Final = {"configure": "inactive", "activate": "active", "autostart": "active"}
#: Characters that no name of a process has.
_FOREIGN: Final = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass
class Translation:
    """A launch file as an application.

    Attributes:
        work: contents of a work file.
        nodes: name of each process to the full name of its node; "": not known, or none.
        omissions: actions without a counterpart.
        notes: facts that a user should know.
    """

    work: dict[str, Any]
    nodes: dict[str, str]
    omissions: list[Omission] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def translated(model: LaunchModel, application: str = "") -> Translation:
    """Return the application of a launch file; its name is by default that of the file.

    Raises:
        ConfigError: the file starts nothing, or two containers have one name.
    """
    return _Translator(model, application or name_of(PurePath(model.file).name.split(".")[0])).run()


def name_of(text: str) -> str:
    """Return a text as the name of a process or application."""
    return _FOREIGN.sub("_", text).strip("._-")[:180] or "process"


class _Translator:
    def __init__(self, model: LaunchModel, application: str) -> None:
        self._model = model
        self._application = application
        self._paths = PackagePaths(model.packages)
        self._omissions = list(model.omissions)
        self._notes = list(model.notes)
        self._started = self._without_endless_waits(model.processes)
        self._names = dict(zip((one.number for one in self._started), self._chosen(), strict=True))
        self._lifecycle = self._lifecycle_goals()
        self._components = self._components_by_container()
        self._jobs = {
            wait.process for one in self._started for wait in one.waits if wait.event == "exited"
        }

    def run(self) -> Translation:
        if not self._started:
            raise ConfigError(f"{self._model.file}: the launch file starts no process")
        work: dict[str, Any] = {"app": self._application}
        ends = [self._names[one.number] for one in self._started if one.ends_all]
        if ends:
            work["group"] = {"name": self._application, "ends_with": ends}
        work["processes"] = [self._entry(one) for one in self._started]
        nodes = {self._names[one.number]: _node_of(one) for one in self._started}
        twice = [node for node, count in Counter(filter(None, nodes.values())).items() if count > 1]
        self._notes += [f"several processes have a node {node}" for node in twice]
        return Translation(work, nodes, self._omissions, self._notes)

    # --- which processes, under which names ---------------------------------------------------

    def _without_endless_waits(self, processes: Sequence[Process]) -> list[Process]:
        """Leave out processes that would start each time when another one ends."""
        endless = {one.number for one in processes if one.respawn}
        kept = []
        for one in processes:
            if any(wait.event == "exited" and wait.process in endless for wait in one.waits):
                endless.add(one.number)  # what waits for it never starts, either
                self._omit(one, _title(one), "it starts at each end of a process that respawns")
            else:
                kept.append(one)
        return kept

    def _chosen(self) -> Iterator[str]:
        """Yield a unique name for each process: that of its node, or of its program."""
        used: set[str] = set()
        for one in self._started:
            stem = name = name_of(_node_of(one).strip("/").replace("/", ".") or _program_of(one))
            number = 2
            while name in used:
                name, number = f"{stem}-{number}", number + 1
            used.add(name)
            yield name

    def _components_by_container(self) -> dict[str, list[dict[str, Any]]]:
        """Return the components of each container in order; list those that cannot be loaded.

        Raises:
            ConfigError: two containers cannot be told apart.
        """
        nodes = [one for one in self._started if one.kind != "command"]
        containers = [one for one in nodes if one.kind == "container"]
        parts: list[tuple[Process | Load, str, Component]] = [
            (one, _node_of(one), part) for one in containers for part in one.components
        ]
        parts += [
            (load, f"/{load.container.strip('/')}", part)
            for load in self._model.loads
            for part in load.components
        ]
        targets = {container for _, container, _ in parts} | set(map(_node_of, containers))
        known = Counter(map(_node_of, nodes))  # a container may be started as a plain node
        for node in targets - {""}:
            if known[node] > 1:
                files = listed(sorted({one.file for one in nodes if _node_of(one) == node}))
                raise ConfigError(
                    f"{files}: {known[node]} containers have the name {node}; rename one"
                )
        found: dict[str, list[dict[str, Any]]] = {}
        for at, container, part in parts:
            title = f"component {part.plugin} of {container or 'a container without a name'}"
            if not container or not known[container]:
                self._omit(at, title, "the file starts no node of this name")
            elif not part.name:
                self._omit(at, title, "it has no name, by which its host could find it again")
            else:
                found.setdefault(container, []).append(self._component(part))
        self._note_sections(parts)
        return found

    def _note_sections(self, parts: Sequence[tuple[Process | Load, str, Component]]) -> None:
        """Note sections of components' files that no node can get: a request has none of them."""
        nodes = {_node_of(one) for one in self._started}
        nodes |= {qualified_name(part.namespace, part.name) for _, _, part in parts}
        of_containers = {
            _node_of(one): {given.nodes for given in one.parameters} for one in self._started
        }
        for at, container, part in parts:
            lacking = set(part.sections) - nodes - of_containers.get(container, set())
            if lacking:
                self._notes.append(
                    f"{at.file}: the parameter files of the component {part.name or part.plugin} "
                    f"have sections for {listed(sorted(lacking))}. If the component makes such "
                    f"nodes, give the files to {container} too: as in launch, its nodes get only "
                    "the parameters of the container"
                )

    def _component(self, part: Component) -> dict[str, Any]:
        entry = {
            "package": part.package, "plugin": part.plugin, "name": part.name,
            "namespace": part.namespace.rstrip("/"),
            "parameters": self._paths.in_texts(part.parameters),
            "remappings": _remappings(part.remappings), "arguments": part.arguments,
        }  # fmt: skip
        return {key: value for key, value in entry.items() if value}

    def _lifecycle_goals(self) -> dict[str, str]:
        """Return the state to which the file brings each node; list all other transitions."""
        known = {_node_of(one) for one in self._started if one.kind in ("lifecycle", "node")}
        goals: dict[str, str] = {}
        for change in self._model.transitions:
            goal = _GOALS.get(change.transition, "")
            nodes = [f"/{node.strip('/')}" for node in change.nodes]
            strange = [node for node in nodes if not goal or node not in known]
            if strange or not nodes:
                whose = listed(strange) if strange else "no node"
                title = f"transition {change.transition} of {whose}"
                why = "the file starts no such node" if goal else "a host makes no such transition"
                self._omit(change, title, why)
            for node in set(nodes) - set(strange):
                goals[node] = "active" if "active" in (goal, goals.get(node)) else goal
        return goals

    def _omit(self, at: Any, action: str, reason: str) -> None:
        self._omissions.append(Omission(file=at.file, action=action, reason=reason))

    # --- one process --------------------------------------------------------------------------

    def _entry(self, one: Process) -> dict[str, Any]:
        """Return the entry of a process in a work file, without what is as by default."""
        entry: dict[str, Any] = {"name": self._names[one.number]}
        if one.kind != "command":
            node = one.name or KEEP_NAME
            entry |= {"node_name": node} if node != entry["name"] else {}
            entry |= {"namespace": one.namespace} if one.namespace else {}
        if one.package:
            entry |= {"package": one.package, "executable": one.executable}
        else:
            words = ["sh", "-c", *one.command] if one.shell else one.command
            entry["command"] = self._paths.in_texts(words)
            entry |= {"ros": True} if one.kind != "command" else {}
        others = {
            "prefix": self._paths.in_texts([*_literal(one.environment), *one.prefix]),
            "arguments": self._paths.in_texts(one.arguments),
            "parameters": self._parameters(one),
            "remappings": _remappings(one.remappings),
            "environment": self._paths.in_texts(
                {name: text for name, text in one.environment.items() if not variable_fault(text)}
            ),
            "working_directory": self._paths.in_texts(one.working_directory),
            "lifecycle": self._lifecycle.get(_node_of(one), ""),
            "components": self._components.get(_node_of(one), []),
            "kind": "job" if one.number in self._jobs else "",
            "restart": _restart(one),
            "stop": _stop(one),
            "after": self._after(one),
        }
        entry |= {key: value for key, value in others.items() if value}
        self._note_paths(one)
        return entry

    def _parameters(self, one: Process) -> Any:
        """Return all sections that launch gives the process, whose program may have many nodes."""
        sources = [
            ParameterSource(nodes=given.nodes, parameters=self._values(one, given.values))
            for given in one.parameters
        ]
        # As launch_ros says: those of a full name override those of a pattern, in any order.
        sources.sort(key=lambda source: "*" not in source.nodes)
        merged = merged_parameters(sources)
        if merged.keys() <= {ALL_NODES}:
            return merged.get(ALL_NODES, {})
        return [{nodes: {SECTION: values}} for nodes, values in merged.items()]

    def _values(self, one: Process, values: Mapping[str, Any]) -> dict[str, Any]:
        empty = [name for name, value in values.items() if value is None or value == []]
        if empty:
            self._notes.append(f"{one.file}: {_title(one)}: no value of {listed(empty)} is given")
        return {
            name: self._paths.in_texts(value) for name, value in values.items() if name not in empty
        }

    def _after(self, one: Process) -> dict[str, Any]:
        after = {
            self._names[wait.process]: "finished" if wait.event == "exited" else "ready"
            for wait in one.waits
        }
        if not one.delay:
            return after
        if not after:
            after = {
                self._names[other.number]: "ready" for other in self._started
                if not (other.delay or other.waits or other.number in self._jobs)
            }  # fmt: skip
            if not after or len(after) > _MOST_AWAITED:
                self._omit(one, f"timer of {_title(one)}", "no process begins before it")
                return {}
            self._notes.append(
                f"{one.file}: {_title(one)} starts {one.delay:g} s after all processes without a "
                "timer are ready"
            )
        return {**after, "delay": one.delay}

    def _note_paths(self, one: Process) -> None:
        outside = [path for path in one.paths if not self._paths.has(path)]
        if outside:
            self._notes.append(
                f"{one.file}: {_title(one)} names {listed(outside)}, which must exist on each host "
                "that may run it"
            )


def _node_of(one: Process) -> str:
    """Return the full name of the node of a process; "": it has none, or it is not known."""
    return qualified_name(one.namespace, one.name) if one.name and is_node_name(one.name) else ""


def _program_of(one: Process) -> str:
    if one.executable or one.label:
        return one.label or one.executable
    words = one.command[0].split() if one.shell and one.command else one.command
    return PurePath(words[0]).name if words else "process"


def _title(one: Process) -> str:
    return _node_of(one) or (f"{one.package}/{one.executable}" if one.package else _program_of(one))


def _remappings(rules: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Return rules by source; of several for one source, ROS applies the first."""
    found: dict[str, str] = {}
    for source, target in rules:
        found.setdefault(source, target)
    return found


def _literal(variables: Mapping[str, str]) -> list[str]:
    """Return the words that set variables with a `$`, which `environment` refuses."""
    words = [f"{name}={text}" for name, text in variables.items() if variable_fault(text)]
    return ["env", *words] if words else []


def _restart(one: Process) -> Any:
    if not one.respawn or one.ends_all:  # launch does not respawn after a shutdown
        return "never"
    attempts = one.respawn_retries if one.respawn_retries >= 0 else _ENDLESS
    return {
        "when": "always", "delay": one.respawn_delay, "max_delay": one.respawn_delay, "factor": 1.0,
        "attempts": attempts,
    }  # fmt: skip


def _stop(one: Process) -> dict[str, float]:
    stop = {"interrupt_grace": one.interrupt_grace, "terminate_grace": one.terminate_grace}
    return stop if set(stop.values()) != {5.0} else {}
