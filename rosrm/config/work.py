"""Loader of `work.yaml`, the processes to run."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, Final

from rosrm.artifacts.pack import source_fault
from rosrm.config.checking import described, near, salvaged, validated
from rosrm.config.documents import Node, Place, Problems, node_of, read
from rosrm.config.foreach import all_expanded
from rosrm.config.groups import grouped
from rosrm.config.kinds import check_kind
from rosrm.config.merging import merged, written_out
from rosrm.config.options import PluginCheck
from rosrm.config.process import ProcessInFile
from rosrm.config.process_rules import about_empty, about_retries, complaints
from rosrm.config.rollout import RolloutInFile
from rosrm.config.rules import (
    check_amounts,
    check_name,
    refuse_namesakes,
    settled,
    settled_on_host,
)
from rosrm.core.master.process_defaults import IDENTITY
from rosrm.extensions.registry import Registry
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.contradictions import contradiction_in
from rosrm.model.dependencies import circle_fault, circle_in, condition_fault
from rosrm.model.gang_rules import gang_array_fault, gang_order_fault
from rosrm.model.placeholders import ARTIFACTS
from rosrm.model.values import ProcessSpec
from rosrm.wording import get_close_matches

_SECTIONS: Final = ProcessInFile.SECTIONS
#: Keys that are allowed in an entry but not in `defaults`.
_NOT_IN_DEFAULTS: Final = ("name", "foreach", "array", "parallel")
#: Keys that are allowed in an entry but not in `defaults.process` of cluster.yaml.
_NOT_IN_CLUSTER_DEFAULTS: Final = (
    *_NOT_IN_DEFAULTS, *IDENTITY, "near", "apart", "spread", "talks_to", "after", "together",
    "artifacts", "retries", "every", "at", "on",
)  # fmt: skip


def load_work(
    path: str | Path, registry: Registry | None = None, *, check_artifacts: bool = True
) -> tuple[ProcessSpec, ...]:
    """Read the processes of a file; raises one `ConfigError` with all problems.

    Args:
        path: path of the file.
        registry: the installed plugins, for a check of the migration strategies; None: only the
            master checks them.
        check_artifacts: False: the files of `artifacts` need not exist.
    """
    return checked_work(read(path), path, registry, check_artifacts=check_artifacts).specs


def load_application(path: str | Path, registry: Registry | None = None) -> Target:
    """Read the application of a file; otherwise as `load_work`.

    A file without `app` is refused.
    """
    root = read(path)
    target = checked_work(root, path, registry)
    if not target.application:
        problems = Problems()
        problems.add(
            root.place,
            "app: the name of the application is required, such as `app: navigation`. To run "
            "single processes, use `rosrm submit`",
        )
        problems.raise_any()
    return target


def processes_of(work: Mapping[str, Any]) -> tuple[ProcessSpec, ...]:
    """Return the processes of a mapping, which is one process or a whole work file.

    Relative paths start at the current directory. Raises one `ConfigError` with all problems.
    """
    if "processes" in work:
        return checked_work(node_of(work, Place("work", 0, 0)), "work", None).specs
    place = Place(f"process {work.get('name')!r}", 0, 0)
    return checked_work(node_of({"processes": [work]}, place), "work", None).specs


def checked_work(
    root: Node, path: str | Path, registry: Registry | None, *, check_artifacts: bool = True
) -> Target:
    """Return the processes of a parsed document, and its application; otherwise as `load_work`."""
    problems = Problems()
    check_kind(root, "work")
    application, rollout = _application(root, problems)
    entries = _entries(root, problems)
    defaults = _defaults(root, problems)
    plugins = PluginCheck(registry, problems)
    complete = (_with_group(merged(defaults, written_out(entry))) for entry in entries)
    nodes = list(all_expanded(complete, problems))
    specs = [_process(node, path, plugins, problems) for node in nodes]
    _refuse_contradictions(nodes, specs, problems)
    refuse_namesakes(nodes, "process", problems)
    members = grouped([spec for spec in specs if spec is not None], root, problems)
    if check_artifacts:
        _check_sources(nodes, specs, problems)
    problems.raise_any()
    parts = tuple(replace(spec, application=application) for spec in members)
    return Target(application, parts, rollout=rollout)


def _application(root: Node, problems: Problems) -> tuple[str, RolloutPolicy]:
    """Return the name of the application, "" for none, and the way of its replacement."""
    app, rollout = root.get("app"), root.get("rollout")
    if app is not None and not isinstance(app.value, str):
        problems.add(
            app.place, f"app: a name is required, not {described(app.plain())}, such as `app: nav`"
        )
    check_name(app, "application", problems)
    if rollout is None:
        return _text_of(app), RolloutPolicy()
    if app is None:
        problems.add(rollout.key_place or rollout.place, "rollout: goes with `app: NAME` only")
    checked = validated(RolloutInFile, rollout, problems, "rollout")
    return _text_of(app), checked.policy() if checked is not None else RolloutPolicy()


def _text_of(node: Node | None) -> str:
    return node.value if node is not None and isinstance(node.value, str) else ""


def _entries(root: Node, problems: Problems) -> Sequence[Node]:
    if not isinstance(root.value, Mapping):
        given = "a list" if isinstance(root.value, tuple) else "text"
        remedy = "put the list under `processes:`" if given == "a list" else "it has `processes:`"
        problems.add(root.place, f"a work file is a mapping, not {given}; {remedy}")
        return ()
    for name, node in root.items.items():
        if name not in _SECTIONS:
            place = node.key_place or node.place
            problems.add(place, f"unknown key {name!r}{near(name, _SECTIONS)}")
    processes = root.get("processes")
    if processes is None and any(get_close_matches(name, ["processes"]) for name in root.items):
        return ()  # a misspelt key, noted above
    if processes is None or not isinstance(processes.value, tuple) or not processes.value:
        place = (processes or root).place
        problems.add(place, "processes: a list of at least one process is required")
        return ()
    for entry in processes.value:
        if not isinstance(entry.value, Mapping):
            problems.add(entry.place, "processes: each entry must be a mapping, with a `name`")
    return [entry for entry in processes.value if isinstance(entry.value, Mapping)]


def _defaults(root: Node, problems: Problems) -> Node:
    defaults = root.get("defaults") or Node({}, root.place)
    _refuse_keys(defaults, _NOT_IN_DEFAULTS, "defaults", problems)
    return written_out(defaults)


def _refuse_keys(defaults: Node, refused: Sequence[str], where: str, problems: Problems) -> None:
    """Note defaults that are no mapping, and the keys of them that only a process may have."""
    if not isinstance(defaults.value, Mapping):
        problems.add(defaults.place, f"{where}: a mapping is required")
    for name in refused:
        node = defaults.get(name)
        if node is not None:
            text = f"{where}: {name} is allowed in a process only"
            problems.add(node.key_place or node.place, text)


def checked_defaults(
    node: Node | None, path: str | Path, plugins: PluginCheck, problems: Problems
) -> ProcessSpec | None:
    """Return `defaults.process` of cluster.yaml as a spec of a placeholder; None: it gives nothing.

    The placeholder is a ROS node, so that the rules for all keys are checked.
    """
    if node is None or not (node.value or isinstance(node.value, (bool, int))):
        return None
    _refuse_keys(node, _NOT_IN_CLUSTER_DEFAULTS, "defaults.process", problems)
    own = {
        name: item
        for name, item in written_out(node).items.items()
        if name not in _NOT_IN_CLUSTER_DEFAULTS
    }
    if "parameters" in own and isinstance(own["parameters"].value, tuple):
        problems.add(
            own["parameters"].place,
            "defaults.process: parameters: only a process has a list of them",
        )
    placeholder = {name: Node("default", node.place) for name in ("name", "package", "executable")}
    return _process(Node({**own, **placeholder}, node.place), path, plugins, problems)


def _with_group(entry: Node) -> Node:
    """Return an entry with `foreach` or `array`, whose processes are a group by default.

    The group of `spread` is the entry's name before the values are put into it.
    """
    name, spread = entry.get("name"), entry.get("spread")
    if name is None or not isinstance(name.value, str) or spread is None:
        return entry
    is_mapping = isinstance(spread.value, Mapping)
    if not {"foreach", "array"} & entry.items.keys() or not is_mapping or "group" in spread.items:
        return entry
    kept = name.value.replace("{", "{{").replace("}", "}}")
    members = {**spread.items, "group": Node(kept, spread.place)}
    spread = Node(members, spread.place, spread.key_place)
    return Node({**entry.items, "spread": spread}, entry.place, entry.key_place)


def _process(
    node: Node, path: str | Path, plugins: PluginCheck, problems: Problems
) -> ProcessSpec | None:
    check_name(node.get("name"), "process", problems)
    check_amounts(node.get("needs"), "needs", problems)
    options = _options_of_strategy(node, plugins)
    process, wrong = salvaged(ProcessInFile, node, problems)
    if process is None:
        return None
    spec = process.spec()
    spec = replace(spec, given=tuple(_given(node, spec)))
    given = {key: item for key, item in node.items.items() if key not in wrong}
    empty = {key for key, item in given.items() if item.value == {}}
    others = (*about_retries(spec, given.keys()), *about_empty(empty))
    for complaint in (*complaints(spec, wrong), *others):
        problems.add(node.deepest(complaint.path).place, complaint.text)
    spec = _on_host(spec, path)
    if options is not None:
        spec = replace(spec, migration=replace(spec.migration, options=options))
    fault = plugins.standby_fault(spec) if wrong.isdisjoint(("standby", "migration")) else ""
    if fault:
        problems.add(node.deepest(("standby",)).place, fault)
    fault = plugins.container_fault(spec) if wrong.isdisjoint(("container", "migration")) else ""
    if fault:
        problems.add(node.deepest(("container",)).place, fault)
    return spec


def _refuse_contradictions(
    nodes: Sequence[Node], specs: Sequence[ProcessSpec | None], problems: Problems
) -> None:
    """Note processes of the file that can never start, or never run where their rules say."""
    if problems:
        return  # a process that names itself is noted already
    known = {spec.name: spec for spec in specs if spec is not None}
    places = {spec.name: node for node, spec in zip(nodes, specs, strict=True) if spec is not None}
    for spec in known.values():
        for name, condition in spec.start_order.after.items():
            fault = condition_fault(known[name], condition) if name in known else ""
            if fault:
                problems.add(places[spec.name].deepest(("after", name)).place, f"after: {fault}")
    after = {name: list(spec.start_order.after) for name, spec in known.items()}
    gang_of = {name: ("", spec.together) for name, spec in known.items() if spec.together}
    circle = circle_in(after)
    if circle:
        problems.add(places[circle[0]].deepest(("after", circle[1])).place, circle_fault(circle))
    elif gang := gang_array_fault(gang_of, known) or gang_order_fault(gang_of, after):
        problems.add(places[gang.process].deepest(gang.path).place, gang.text)
    fault = contradiction_in(known) if any(spec.neighbours for spec in known.values()) else ""
    if fault:
        problems.add(places[fault.partition(" ")[0].rstrip(":")].place, fault)


def _check_sources(
    nodes: Sequence[Node], specs: Sequence[ProcessSpec | None], problems: Problems
) -> None:
    """Note the artifacts that are no files or directories, each path once."""
    checked: set[str] = set()
    for node, spec in zip(nodes, specs, strict=True):
        for one in spec.artifacts if spec is not None else ():
            fault = source_fault(one.source) if one.source and one.source not in checked else ""
            checked.add(one.source)
            if fault:
                place = node.deepest(("artifacts", one.name)).place
                problems.add(place, f"artifacts.{one.name}: {fault}")
        fault = _program_fault(spec) if spec is not None else ""
        if fault:
            problems.add(node.deepest(("command",)).place, f"command: {fault}")


def _program_fault(spec: ProcessSpec) -> str:
    """Return why no host can start an artifact that is the program; "": hosts can."""
    program = spec.command[0] if spec.command else ""
    sources = {f"{{{ARTIFACTS}}}/{one.name}": Path(one.source) for one in spec.artifacts}
    source = sources.get(program)
    if source is None or not source.is_file() or os.access(source, os.X_OK):
        return ""
    return (
        f"{program} is not executable. Run `chmod +x {source.name}`, or begin the command with an "
        f"interpreter: [python3, {json.dumps(program)}]"
    )


def _given(node: Node, value: Any, before: str = "") -> Iterator[str]:
    """Yield the paths of the keys in an entry: of each field, and of each field of a policy."""
    for name, inner in node.items.items():
        policy = getattr(value, name, None)
        if name == "retries":  # a short form of `restart`
            yield from (f"restart.{one}" for one in ("when", "attempts", "window"))
        elif inner.items and is_dataclass(policy):
            yield from _given(inner, policy, f"{before}{name}.")
        else:
            yield f"{before}{name}"


def _options_of_strategy(node: Node, plugins: PluginCheck) -> Mapping[str, Any] | None:
    """Return the checked options of a process; None if the process names no strategy.

    Options that the process omits have the cluster's values. Name and options are checked even if
    there are other errors in `migration`.
    """
    strategy, given = node.get("migration", "strategy"), node.get("migration", "options")
    if strategy is None or not isinstance(strategy.value, str):
        return None
    own = given.items if given is not None else {}
    options = given if own else None
    checked = plugins.choice("migration", strategy.value, strategy, options, part="own_options")
    return {name: value for name, value in checked.items() if name in own}


def _on_host(spec: ProcessSpec, path: str | Path) -> ProcessSpec:
    """Return the spec with its program, directory and artifacts resolved against the file."""
    directory, command = spec.working_directory, spec.command
    if directory:
        spec = replace(spec, working_directory=settled_on_host(directory, path))
    if command and "/" in command[0]:
        spec = replace(spec, command=(settled_on_host(command[0], path), *command[1:]))
    sources = tuple(
        replace(one, file=settled_on_host(one.file, path)) if one.file else one
        for one in spec.parameter_sources
    )
    here = (
        replace(one, source=str(settled(Path(one.source), path))) if one.source else one
        for one in spec.artifacts
    )
    return replace(spec, artifacts=tuple(here), parameter_sources=sources)
