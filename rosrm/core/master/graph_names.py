"""Node names that several processes share in the ROS graph, derived from their specs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from rosrm.model.values import ProcessSpec, qualified_name
from rosrm.wording import listed

_RUN: Final = ("ros2", "run")


def shared_nodes(processes: Iterable[tuple[str, str]]) -> list[str]:
    """Return a sentence for each node name that several processes put into the ROS graph.

    `processes`: the name of each, with its node as `node_of` returns it.
    """
    users: dict[str, list[str]] = {}
    for name, node in processes:
        if node:
            users.setdefault(node, []).append(name)
    return [
        f"{listed(names)} put {node} into the ROS graph; give each node its own name"
        for node, names in users.items()
        if len(names) > 1
    ]


def node_of(spec: ProcessSpec) -> str:
    """Return a phrase for the node that a process adds to the graph; "" if its spec names none.

    rosrm appends its remapping rule to the user's arguments, and ROS applies the first rule.
    """
    words = (*spec.command, *spec.arguments)
    rules = dict(
        word.split(":=", 1) for word in reversed(words) if word.startswith(("__node:=", "__ns:="))
    )
    name = rules.get("__node") or (spec.node if spec.ros else "")
    if name:
        return f"the node {qualified_name(rules.get('__ns', spec.namespace), name)}"
    if spec.command[:2] == _RUN and len(spec.command) >= 4:
        return f"the default node of {' '.join(spec.command[2:4])}"
    return ""
