"""ROS parameters from several sources: sections of parameter files, patterns of nodes, merging."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from rosrm.model.values import ALL_NODES, ParameterSource

#: Key below which a parameters file of ROS has the parameters of a node.
SECTION: Final = "ros__parameters"
_PATTERN: Final = re.compile(r"(/([A-Za-z_][A-Za-z0-9_]*|\*\*?))+")
_LONGEST_PATTERN: Final = 255


def pattern_fault(nodes: str) -> str:
    """Return why a text is no pattern of nodes; "" if it is one."""
    if len(nodes) <= _LONGEST_PATTERN and _PATTERN.fullmatch(nodes):
        return ""
    return f"{nodes!r:.250} is no name or pattern of nodes, such as /robot/planner, /robot/* or /**"


def flattened(parameters: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield nested parameters by their dotted names, as in ROS."""
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def has_sections(document: Any) -> bool:
    """Return True for the contents of a parameters file, False for mere parameters."""
    return isinstance(document, Mapping) and any(
        isinstance(inner, Mapping) and (SECTION in inner or has_sections(inner))
        for inner in document.values()
    )


def sections_of(document: Any, before: str = "") -> Iterator[ParameterSource]:
    """Yield the sections of a parsed parameters file in their order.

    Raises:
        ValueError: the document has another form.
    """
    if not isinstance(document, Mapping):
        text = f"names of nodes with `{SECTION}` below them are required"
        raise ValueError(text)  # noqa: TRY004 - a fault of a document
    for key, inner in document.items():
        nodes = f"{before}/{str(key).strip('/')}"
        if not isinstance(inner, Mapping):
            text = f"{key}: `{SECTION}` is required below the name of a node"
            raise ValueError(text)  # noqa: TRY004 - a fault of a document
        others = {name: value for name, value in inner.items() if name != SECTION}
        if SECTION in inner:
            parameters = inner[SECTION] or {}
            fault = pattern_fault(nodes)
            if fault or not isinstance(parameters, Mapping):
                raise ValueError(fault or f"{key}.{SECTION}: a mapping is required")
            yield ParameterSource(nodes=nodes, parameters=dict(flattened(parameters)))
        if others:
            yield from sections_of(others, nodes)


def applies_to(nodes: str, name: str) -> bool:
    """Return True if a pattern of nodes includes a fully qualified name.

    `*` stands for one part of the name, and `**` for any number of parts, as in ROS.
    """
    parts = {"*": "/[^/]+", "**": "(/[^/]+)*"}
    expression = "".join(parts.get(part, "/" + re.escape(part)) for part in nodes.split("/")[1:])
    return re.fullmatch(expression, name) is not None


def merged_parameters(sources: Iterable[ParameterSource], name: str) -> dict[str, dict[str, Any]]:
    """Return parameters by pattern of nodes, later sources over earlier ones.

    Args:
        sources: without files.
        name: fully qualified name of the only node: it gets all that applies to it, under
            `ALL_NODES`. "": unknown; each pattern remains.
    """
    merged: dict[str, dict[str, Any]] = {}
    for source in sources:
        if not name:
            # ROS applies sections in their order, and a repeated one at its first place.
            own = {**merged.pop(source.nodes, {}), **source.parameters}
            merged[source.nodes] = own
        elif applies_to(source.nodes, name):
            merged.setdefault(ALL_NODES, {}).update(source.parameters)
    return {nodes: parameters for nodes, parameters in merged.items() if parameters}
