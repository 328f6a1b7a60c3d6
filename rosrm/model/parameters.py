"""ROS parameters from several sources: sections of parameter files, patterns of nodes, merging."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from rosrm.model.values import ALL_NODES, ParameterSource

#: Key below which a parameters file of ROS has the parameters of a node.
SECTION: Final = "ros__parameters"
_PATTERN: Final = re.compile(r"(/([A-Za-z_][A-Za-z0-9_]*|\*\*?))+")
_LONGEST_PATTERN: Final = 255
#: Characters at which ROS ends a text, or which no file can have.
_UNPASSABLE: Final = re.compile("[\0\ud800-\udfff]")


def pattern_fault(nodes: str) -> str:
    """Return why a text is no pattern of nodes; "" if it is one."""
    if len(nodes) <= _LONGEST_PATTERN and _PATTERN.fullmatch(nodes):
        return ""
    return f"{nodes!r:.250} is no name or pattern of nodes, such as /robot/planner, /robot/* or /**"


def parameter_fault(name: str, value: Any) -> str:
    """Return why a ROS parameter cannot be given to a node; "" if it can."""
    if not name or not name.isprintable():
        return f"{name!r:.100} is no name of a parameter"
    if value is None:
        return "a value is required; ROS has no null"
    if value in ([], ()):
        return "an empty list has no type, so no node can be given one; leave the parameter out"
    items = value if isinstance(value, (list, tuple)) else [value]
    kinds = {type(item) for item in items}
    if kinds - {bool, int, float, str}:
        return "a list in ROS parameters has only booleans, numbers or text"
    if any(isinstance(item, float) and not math.isfinite(item) for item in items):
        return "a finite number is required"
    if any(isinstance(item, int) and not -(2**63) <= item < 2**63 for item in items):
        return "a whole number of 64 bits is required, -2**63 to 2**63 - 1"
    if any(isinstance(item, str) and _UNPASSABLE.search(item) for item in items):
        return "a text without the character NUL and without lone surrogates is required"
    return "a list in ROS parameters has values of one type only" if len(kinds) > 1 else ""


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


def merged_parameters(
    sources: Iterable[ParameterSource], name: str = "", started: str = ""
) -> dict[str, dict[str, Any]]:
    """Return the parameters of a process by pattern of nodes, as one file instead of several.

    Each section remains, because a program may have several nodes. As in ROS, a repeated section
    is at its first place, with its last values. The last section is that of the node of the
    process: it has all that applies to this node, because rclpy knows no pattern but `ALL_NODES`.

    Args:
        sources: with `file`: a section of that file, in which a full name overrides patterns;
            without: an entry of the user, which overrides everything before it.
        name: fully qualified name of the node of the process; "": unknown.
        started: its full name in this run, such as the alias of a handoff.
    """
    merged: dict[str, dict[str, Any]] = {}
    by_pattern: dict[str, Any] = {}
    by_name: dict[str, Any] = {}
    for source in sources:
        merged.setdefault(source.nodes, {}).update(source.parameters)
        if source.nodes == name:
            by_name.update(source.parameters)
        elif name and applies_to(source.nodes, name):
            by_pattern.update(source.parameters)
            if not source.file:
                by_name = {
                    key: value for key, value in by_name.items() if key not in source.parameters
                }
    own = {**by_pattern, **by_name}
    merged.pop(name, None)
    if own != merged.get(ALL_NODES, {}):
        merged[started or name] = own
    return {nodes: parameters for nodes, parameters in merged.items() if parameters}
