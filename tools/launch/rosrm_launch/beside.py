"""The file beside a launch file: what launch cannot say, by the names of nodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from rosrm.config.checking import near
from rosrm.config.documents import Node, Place, Problems, node_of, read
from rosrm.config.merging import in_depth, written_out
from rosrm_launch.translate import Translation

#: Keys of a process that the launch file gives.
_OF_LAUNCH: Final = (
    "name", "node_name", "namespace", "package", "executable", "module", "command", "prefix",
    "arguments", "parameters", "remappings", "foreach", "array",
)  # fmt: skip
_SECTIONS: Final = ("nodes", "rollout")


def path_beside(file: Path) -> Path:
    """Return the path of the file beside a launch file: robot.rosrm.yaml for robot.launch.py."""
    return file.with_name(f"{file.name.split('.')[0]}.rosrm.yaml")


def completed(translation: Translation, file: Path, beside: Path | None) -> Node:
    """Return a work file with the settings of the file beside; raises `ConfigError`.

    `beside`: None: there is none.
    """
    place = Place(str(file), 0, 0)
    work = node_of(translation.work, place)
    if beside is None:
        return work
    problems, settings = Problems(), read(beside)
    entries = work.items["processes"].value
    assert isinstance(entries, tuple)
    given = list(_given(settings, translation.nodes, problems))
    members = []
    for entry in entries:
        name = str(entry.items["name"].value)
        whole = written_out(entry)
        for pattern, own in given:
            if _fits(pattern, name, translation.nodes[name]):
                whole = in_depth(whole, written_out(own))
        members.append(whole)
    problems.raise_any()
    sections = {**work.items, "processes": Node(tuple(members), work.place)}
    if settings.get("rollout") is not None:
        sections["rollout"] = settings.items["rollout"]
    return Node(sections, work.place)


def _given(
    settings: Node, nodes: Mapping[str, str], problems: Problems
) -> Iterator[tuple[str, Node]]:
    """Yield each pattern with its settings, and note what is wrong in the file."""
    for key, node in settings.items.items():
        if key not in _SECTIONS:
            text = f"unknown key {key!r}{near(key, _SECTIONS)}"
            problems.add(node.key_place or node.place, text)
    section = settings.get("nodes")
    if section is None or not isinstance(section.value, Mapping):
        text = "nodes: a mapping is required, from names or patterns of nodes to settings"
        problems.add((section or settings).place, text)
        return
    for pattern, own in section.items.items():
        where = own.key_place or own.place
        if not any(_fits(pattern, name, node) for name, node in nodes.items()):
            known = [*nodes, *filter(None, nodes.values())]
            problems.add(where, f"nodes: no process or node is {pattern!r}{near(pattern, known)}")
        if not isinstance(own.value, Mapping):
            problems.add(own.place, f"nodes: {pattern}: a mapping is required")
            continue
        for key, node in own.items.items():
            if key in _OF_LAUNCH:
                text = f"nodes: {pattern}: {key} is in the launch file"
                problems.add(node.key_place or node.place, text)
        yield pattern, own


def _fits(pattern: str, name: str, node: str) -> bool:
    return fnmatchcase(name, pattern) or bool(node and fnmatchcase(node, pattern))
