"""Completion of work file entries: shorthands written out, `defaults` merged in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from rosrm.config.documents import Node

#: Keys that select the program; one of them in an entry replaces all of them in the defaults.
_PROGRAM: Final = ("package", "executable", "module", "command")


def written_out(entry: Node) -> Node:
    """Return an entry with all shorthands in long form, as merging requires."""
    members = {
        name: _LONG_FORMS[name](node) if name in _LONG_FORMS else node
        for name, node in entry.items.items()
    }
    return Node(members, entry.place, entry.key_place)


def merged(defaults: Node, entry: Node) -> Node:
    """Return an entry with defaults for missing keys, mappings merged deeply; both in long form."""
    under = dict(defaults.items)
    if any(name in entry.items for name in _PROGRAM):
        under = {name: node for name, node in under.items() if name not in _PROGRAM}
    for own, other in (
        ("restart", "retries"),
        ("retries", "restart"),
        ("every", "at"),
        ("at", "every"),
    ):
        if own in entry.items:  # each excludes the other
            under.pop(other, None)
    if entry.get("migration", "strategy") is not None and "migration" in under:
        under["migration"] = _without_options(under["migration"])
    return in_depth(Node(under, entry.place), entry)


def in_depth(under: Node, over: Node) -> Node:
    """Return `over` merged over `under`: mappings deeply, other values as a whole."""
    if not isinstance(under.value, Mapping) or not isinstance(over.value, Mapping):
        return over
    members = dict(under.items)
    for name, node in over.items.items():
        members[name] = in_depth(members[name], node) if name in members else node
    return Node(members, over.place, over.key_place)


def _without_options(node: Node) -> Node:
    members = {key: item for key, item in node.items.items() if key != "options"}
    return Node(members, node.place, node.key_place) if node.items else node


def _word(name: str) -> Callable[[Node], Node]:
    """Return a conversion such as `restart: always` to `restart: {when: always}`, for any key."""

    def long_form(node: Node) -> Node:
        if isinstance(node.value, Mapping):
            return node
        return Node({name: Node(node.value, node.place)}, node.place, node.key_place)

    return long_form


def _pairs(node: Node) -> Node:
    """Convert `[[from, to]]` to `{from: to}`, as in ROS 2 launch."""
    if not isinstance(node.value, tuple):
        return node
    members: dict[str, Node] = {}
    for item in node.value:
        pair = item.value
        if not isinstance(pair, tuple) or len(pair) != 2 or not isinstance(pair[0].value, str):
            return node
        members[pair[0].value] = pair[1]
    return Node(members, node.place, node.key_place)


def _list(node: Node) -> Node:
    """Convert a single value to a list of one."""
    many = isinstance(node.value, (tuple, Mapping))
    return node if many else Node((node,), node.place, node.key_place)


def _neighbours(node: Node) -> Node:
    """Convert `camera` and `[camera, {processes: [map]}]` to a list of mappings."""
    items = node.value if isinstance(node.value, tuple) else (node,)
    names = tuple(item for item in items if not isinstance(item.value, Mapping))
    rules = tuple(item for item in items if isinstance(item.value, Mapping))
    if names:
        rules = (Node({"processes": Node(names, node.place)}, node.place), *rules)
    return Node(rules, node.place, node.key_place)


def _after(node: Node) -> Node:
    """Convert `camera` and `[camera, lidar]` to `{camera: ready, lidar: ready}`."""
    items = node.value if isinstance(node.value, tuple) else (node,)
    if isinstance(node.value, Mapping) or not all(isinstance(one.value, str) for one in items):
        return node
    members = {str(one.value): Node("ready", one.place) for one in items}
    return Node(members, node.place, node.key_place)


_LONG_FORMS: Final[Mapping[str, Callable[[Node], Node]]] = {
    "restart": _word("when"),
    "migration": _word("strategy"),
    "readiness": _word("kind"),
    "lifecycle": _word("autostart"),
    "host_loss": _word("then"),
    "isolation": _word("then"),
    "standby": _word("wanted"),
    "remappings": _pairs,
    "near": _neighbours,
    "apart": _neighbours,
    "spread": _word("by"),
    "at": _list,
    "on": _list,
    "after": _after,
    "container": _word("image"),
}
