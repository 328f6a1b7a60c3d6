"""Loader of `modes.yaml`, sets of applications of which one is in force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rosrm.config.checking import near, validated
from rosrm.config.documents import Node, Problems, read
from rosrm.config.kinds import check_kind
from rosrm.config.options import PluginCheck
from rosrm.config.process import ListOfWords
from rosrm.config.rules import check_name, settled
from rosrm.config.work import load_application
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import Fraction, Quantity, ResourceName
from rosrm.model.applications import Target
from rosrm.model.modes import Mode, Trigger
from rosrm.model.parameters import flattened
from rosrm.model.values import EMPTY, ParameterSource, ProcessSpec

_CONDITIONS: Final = ("host_lost", "over_limit")
_FOR: Final = Quantity("duration")


@dataclass(frozen=True, slots=True)
class ModeInFile:
    """Keys of a mode, except `when`; see `Mode`.

    Attributes:
        applications: paths of work files with `app`.
        parameters: name of a process to the parameters that it has in this mode only.
    """

    applications: ListOfWords
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: EMPTY)
    limits: Mapping[ResourceName, Fraction] = field(default_factory=lambda: EMPTY)
    weights: Mapping[ResourceName, Fraction] = field(default_factory=lambda: EMPTY)


def load_modes(path: str | Path, registry: Registry | None = None) -> tuple[Mode, ...]:
    """Read the modes of a file and the work files that they name.

    Args:
        path: path of the file.
        registry: the installed plugins, for a check of resources and strategies; None: no check.

    Raises:
        ConfigError: with all problems of the file, or of the first work file that has any.
    """
    return checked_modes(read(path), path, registry)


def checked_modes(root: Node, path: str | Path, registry: Registry | None) -> tuple[Mode, ...]:
    """Return the modes of a parsed document; otherwise as `load_modes`."""
    problems = Problems()
    check_kind(root, "modes")
    for name, node in root.items.items():
        if name != "modes":
            text = f"unknown key {name!r}{near(name, ['modes'])}"
            problems.add(node.key_place or node.place, text)
    entries = root.get("modes")
    if entries is None or not entries.items:
        place = (entries or root).place
        text = "modes: a mapping of at least one mode is required, such as "
        problems.add(place, text + "`modes: {exploring: {applications: [navigation.yaml]}}`")
        entries = Node({}, root.place)
    plugins = PluginCheck(registry, problems)
    modes = [_mode(name, node, plugins, problems) for name, node in entries.items.items()]
    problems.raise_any()
    loaded: dict[str, Target] = {}
    found = []
    for (mode, keys), node in zip(
        [one for one in modes if one is not None], entries.items.values(), strict=True
    ):
        for file in keys.applications:
            if file not in loaded:
                loaded[file] = load_application(settled(Path(file), path), registry)
        targets = tuple(loaded[file] for file in keys.applications)
        _check_namesakes(targets, node, problems)
        targets = _with_parameters(targets, keys.parameters, node, problems)
        found.append(replace(mode, targets=targets))
    problems.raise_any()
    return tuple(found)


def _mode(
    name: str, node: Node, plugins: PluginCheck, problems: Problems
) -> tuple[Mode, ModeInFile] | None:
    """Return a mode without its applications, and its keys; None: it is invalid."""
    check_name(Node(name, node.key_place or node.place), "mode", problems)
    if not isinstance(node.value, Mapping):
        text = f"{name}: a mapping is required, such as `{name}: {{applications: [work.yaml]}}`"
        problems.add(node.place, text)
        return None
    when = _trigger(node.get("when"), plugins, problems)
    rest = {key: item for key, item in node.items.items() if key != "when"}
    keys = validated(ModeInFile, Node(rest, node.place, node.key_place), problems)
    plugins.check_resources(node.get("limits"), "limits")
    plugins.check_resources(node.get("weights"), "weights")
    if keys is None:
        return None
    if not keys.applications:
        problems.add(node.deepest(("applications",)).place, "applications: give at least one file")
    return Mode(name, (), keys.limits, keys.weights, when), keys


def _trigger(node: Node | None, plugins: PluginCheck, problems: Problems) -> Trigger:
    """Return the condition of `when`."""
    if node is None:
        return Trigger()
    example = "such as `when: {host_lost: robot-2}` or `when: {over_limit: memory, for: 30s}`"
    given = [name for name in _CONDITIONS if name in node.items]
    if len(given) != 1 or not isinstance(node.items[given[0]].value, str):
        problems.add(node.place, f"when: one condition is required, {example}")
        return Trigger()
    for name, item in node.items.items():
        if name not in (*_CONDITIONS, "for"):
            text = f"when: unknown key {name!r}{near(name, (*_CONDITIONS, 'for'))}"
            problems.add(item.key_place or item.place, text)
    condition, value = given[0], node.items[given[0]]
    lasts = node.get("for")
    if condition == "host_lost":
        check_name(value, "host", problems)
        if lasts is not None:
            text = "for: goes with over_limit only; a host counts as lost after `liveness.lost`"
            problems.add(lasts.place, f"when: {text}")
        return Trigger(host_lost=str(value.value))
    plugins.check_resources(Node({str(value.value): value}, value.place), "when.over_limit")
    seconds = 0.0
    try:
        seconds = _FOR.parse(lasts.plain()) if lasts is not None else 0.0
    except ValueError as error:
        problems.add(node.deepest(("for",)).place, f"when.for: {error}")
    return Trigger(over_limit=str(value.value), lasts=seconds)


def _check_namesakes(targets: tuple[Target, ...], node: Node, problems: Problems) -> None:
    """Note applications and processes that two files of a mode have."""
    place = node.deepest(("applications",)).place
    applications: set[str] = set()
    owners: dict[str, str] = {}
    for target in targets:
        name = target.application
        if name in applications:
            problems.add(place, f"applications: two files have the application {name!r}")
        applications.add(name)
        for spec in target.specs:
            other = owners.setdefault(spec.name, name)
            if other != name:
                text = f"{other} and {name} both have a process {spec.name!r}; names are unique"
                problems.add(place, f"applications: {text}")


def _with_parameters(
    targets: tuple[Target, ...], parameters: Mapping[str, Mapping[str, Any]], node: Node,
    problems: Problems,
) -> tuple[Target, ...]:  # fmt: skip
    """Return applications with the parameters of a mode."""
    specs = {spec.name: spec for target in targets for spec in target.specs}
    for name in parameters:
        place = node.deepest(("parameters", name)).place
        if name not in specs:
            text = f"no application of the mode has a process {name!r}{near(name, specs)}"
            problems.add(place, f"parameters: {text}")
        elif not specs[name].ros:
            text = f"{name} is no ROS node (`package`, or `ros: true`), so it has no parameters"
            problems.add(place, f"parameters: {text}")

    def changed(spec: ProcessSpec) -> ProcessSpec:
        own = dict(flattened(parameters.get(spec.name, EMPTY)))
        if own and spec.parameter_sources:  # which override `parameters`
            last = ParameterSource(parameters=own)
            return replace(spec, parameter_sources=(*spec.parameter_sources, last))
        return replace(spec, parameters={**spec.parameters, **own}) if own else spec

    return tuple(replace(one, specs=tuple(map(changed, one.specs))) for one in targets)
