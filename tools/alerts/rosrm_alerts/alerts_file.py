"""Loader of `alerts.yaml`: alerts, sinks, and tests of the alerts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from rosrm.config.checking import near, validated
from rosrm.config.documents import Node, Problems, read
from rosrm.config.options import PluginCheck
from rosrm.config.rules import check_name
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import Quantity
from rosrm_alerts.conditions import Alert, Condition, Happens
from rosrm_alerts.file_forms import CONDITIONS, EVENT_KINDS, AlertInFile, Forwarded, TestInFile
from rosrm_alerts.rehearsal import Rehearsal

T = TypeVar("T")

_SECTIONS: Final = ("sinks", "events", "alerts", "tests")
_EXAMPLE: Final = "such as `{over_limit: memory, for: 30s}` or `{event: failed}`"
_FOR: Final = Quantity("duration")


@dataclass(frozen=True, slots=True)
class ChosenSink:
    """A sink by its name in the file.

    Attributes:
        use: name of the installed sink.
        options: as the file gives them, in base units.
    """

    name: str
    use: str
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class AlertsFile:
    """The checked contents of a file."""

    sinks: tuple[ChosenSink, ...] = ()
    forwarded: tuple[Forwarded, ...] = ()
    alerts: tuple[Alert, ...] = ()
    tests: tuple[Rehearsal, ...] = ()


def load_alerts(path: Path, registry: Registry | None = None) -> AlertsFile:
    """Read a file with alerts.

    Args:
        path: path of the file.
        registry: the installed plugins, for a check of sinks and resources; None: no check.

    Raises:
        ConfigError: with all problems of the file.
    """
    root, problems = read(path), Problems()
    if not isinstance(root.value, Mapping) or not root.items:
        problems.add(root.place, f"a mapping is required, with {' or '.join(_SECTIONS[:3])}")
        problems.raise_any()
    for name, node in root.items.items():
        if name not in _SECTIONS:
            text = f"unknown key {name!r}{near(name, _SECTIONS)}"
            problems.add(node.key_place or node.place, text)
    plugins = PluginCheck(registry, problems)
    sinks = [
        _sink(name, node, plugins, problems) for name, node in _section(root, "sinks", problems)
    ]
    alerts = [
        _alert(name, node, plugins, problems) for name, node in _section(root, "alerts", problems)
    ]
    forwarded = _items(root, "events", Forwarded, problems)
    tests = _items(root, "tests", TestInFile, problems)
    file = AlertsFile(
        tuple(one for one in sinks if one is not None),
        tuple(one for one, _ in forwarded),
        tuple(one for one in alerts if one is not None),
        tuple(one.rehearsal() for one, _ in tests),
    )
    _check_references(file, root, problems)
    problems.raise_any()
    return file


def _section(root: Node, name: str, problems: Problems) -> list[tuple[str, Node]]:
    """Return the entries of a section by name, each a mapping; note all others."""
    section = root.get(name)
    if section is None or section.value is None:
        return []
    if not isinstance(section.value, Mapping):
        problems.add(section.place, f"{name}: a mapping from names is required")
        return []
    for key, node in section.items.items():
        check_name(Node(key, node.key_place or node.place), name.removesuffix("s"), problems)
        if not isinstance(node.value, Mapping):
            problems.add(node.place, f"{name}.{key}: a mapping is required")
    return [(key, node) for key, node in section.items.items() if isinstance(node.value, Mapping)]


def _sink(name: str, node: Node, plugins: PluginCheck, problems: Problems) -> ChosenSink | None:
    named = node.get("use")
    if named is None or not isinstance(named.value, str):
        problems.add(node.place, f"sinks.{name}: `use` is missing, such as `use: webhook`")
        return None
    given = {key: item for key, item in node.items.items() if key != "use"}
    options = plugins.choice("sink", named.value, named, Node(given, node.place, node.key_place))
    return ChosenSink(name, named.value, options)


def _alert(name: str, node: Node, plugins: PluginCheck, problems: Problems) -> Alert | None:
    rest = {key: item for key, item in node.items.items() if key != "when"}
    keys = validated(
        AlertInFile, Node(rest, node.place, node.key_place), problems, f"alerts.{name}"
    )
    when = node.get("when")
    if when is None or not isinstance(when.value, Mapping):
        problems.add(
            (when or node).place, f"alerts.{name}: when: a condition is required, {_EXAMPLE}"
        )
        return None
    condition = _condition(when, f"alerts.{name}: when", plugins, problems)
    lasts = _lasts(when, f"alerts.{name}: when.for", problems)
    if isinstance(condition, Happens) and "for" in when.items:
        problems.add(
            when.deepest(("for",)).place,
            f"alerts.{name}: when.for: an event has no duration; `count: 3, within: 10min` counts",
        )
    if keys is None or condition is None:
        return None
    return Alert(name, condition, lasts, keys.level, keys.to)


def _condition(
    when: Node, where: str, plugins: PluginCheck, problems: Problems
) -> Condition | None:
    given = [key for key in CONDITIONS if key in when.items]
    if len(given) != 1:
        allowed = ", ".join(CONDITIONS)
        problems.add(when.place, f"{where}: exactly one of {allowed} is required, {_EXAMPLE}")
        return None
    rest = {key: item for key, item in when.items.items() if key != "for"}
    keys = validated(CONDITIONS[given[0]], Node(rest, when.place, when.key_place), problems, where)
    for key in ("over_limit", "above"):
        named = when.get(key)
        if named is not None:
            single = Node({str(named.value): named}, named.place)
            plugins.check_resources(single if key == "over_limit" else named, f"{where}.{key}")
    if keys is None:
        return None
    try:
        return keys.condition()
    except ValueError as error:
        problems.add(when.deepest((given[0],)).place, f"{where}: {error}")
        return None


def _lasts(when: Node, where: str, problems: Problems) -> float:
    """Return `for` in seconds."""
    node = when.get("for")
    if node is None:
        return 0.0
    try:
        return _FOR.parse(node.plain())
    except ValueError as error:
        problems.add(node.place, f"{where}: {error}")
        return 0.0


def _items(root: Node, name: str, wanted: type[T], problems: Problems) -> list[tuple[T, Node]]:
    """Return the valid items of a list."""
    section = root.get(name)
    if section is None or section.value is None:
        return []
    if not isinstance(section.value, tuple):
        problems.add(section.place, f"{name}: a list is required")
        return []
    made = [
        (validated(wanted, node, problems, f"{name}[{number}]"), node)
        for number, node in enumerate(section.value)
    ]
    return [(one, node) for one, node in made if one is not None]


def _check_references(file: AlertsFile, root: Node, problems: Problems) -> None:
    """Note sinks and alerts that are named and not defined."""
    sinks = [sink.name for sink in file.sinks]
    alerts = [alert.name for alert in file.alerts]
    for alert in file.alerts:
        for sink in alert.to:
            _check_one(sink, sinks, "sink", root, ("alerts", alert.name, "to"), problems)
    for number, forwarded in enumerate(file.forwarded):
        for sink in forwarded.to:
            _check_one(sink, sinks, "sink", root, ("events", number, "to"), problems)
        for kind in forwarded.kinds:
            _check_one(kind, EVENT_KINDS, "kind", root, ("events", number, "kinds"), problems)
    for number, test in enumerate(file.tests):
        for expected in test.expected:
            _check_one(expected.alert, alerts, "alert", root, ("tests", number, "expect"), problems)


def _check_one(
    name: str, known: Sequence[str], what: str, root: Node, path: tuple[str | int, ...],
    problems: Problems,
) -> None:  # fmt: skip
    if name not in known:
        where = ".".join(map(str, path))
        text = f"{where}: no {what} {name!r} here{near(name, list(known))}"
        problems.add(root.deepest(path).place, text)
