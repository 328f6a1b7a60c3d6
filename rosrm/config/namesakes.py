"""Check for duplicate names in a file."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm.config.documents import Node, Place, Problems


def refuse_namesakes(nodes: Sequence[Node], what: str, problems: Problems) -> None:
    """Note every duplicate name in a list of entries.

    Args:
        nodes: the entries.
        what: kind of the entries, for messages.
        problems: receives every problem.
    """
    first: dict[str, Place] = {}
    for node in nodes:
        name = node.get("name")
        if name is None or not isinstance(name.value, str):
            continue
        before = first.get(name.value)
        if before is None:
            first[name.value] = name.place
        elif before == name.place:
            text = f"foreach gives every {what} the name {name.value!r}; put one of its names in"
            problems.add(name.place, text)
        else:
            where = f"first given at line {before.line}, column {before.column}"
            problems.add(name.place, f"duplicate {what} name {name.value!r}, {where}")
