"""Containers, and the components that are loaded into them."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from launch_ros import actions as ros
from launch_ros.actions.load_composable_nodes import get_composable_node_load_request
from launch_ros.utilities import evaluate_parameters

from rosrm_launch.model import Component, Load
from rosrm_launch.visiting.processes import add_node
from rosrm_launch.visiting.state import Visit, hidden
from rosrm_launch.words import sections_in

#: Field of a parameter's value, by its type.
_FIELDS: Final = (
    "", "bool_value", "integer_value", "double_value", "string_value", "byte_array_value",
    "bool_array_value", "integer_array_value", "double_array_value", "string_array_value",
)  # fmt: skip


def visit_container(visit: Visit, action: Any) -> None:
    """Record the process of a container, with its own components."""
    described = hidden(action, ros.ComposableNodeContainer, "composable_node_descriptions")
    add_node(visit, action, "container", _components(visit, described or ()))


def visit_load(visit: Visit, action: Any) -> None:
    """Record components that are loaded into a container by its name."""
    target = hidden(action, ros.LoadComposableNodes, "target_container")
    is_container = isinstance(target, ros.ComposableNodeContainer)
    name = target.node_name if is_container else visit.text(target)
    described = hidden(action, ros.LoadComposableNodes, "composable_node_descriptions")
    components = _components(visit, described)
    visit.loads.append(Load(file=visit.file, container=name, components=components))


def _components(visit: Visit, described: Sequence[Any]) -> list[Component]:
    """Return the components whose conditions hold, as launch would request them."""
    requests = ((it, get_composable_node_load_request(it, visit.context)) for it in described)
    return [
        Component(
            package=one.package_name, plugin=one.plugin_name, name=one.node_name,
            namespace=one.node_namespace, parameters=_values(one.parameters),
            remappings=[tuple(rule.split(":=", 1)) for rule in one.remap_rules],
            arguments=_values(one.extra_arguments), sections=_sections(visit, it),
        )
        for it, one in requests
        if one is not None
    ]  # fmt: skip


def _sections(visit: Visit, described: Any) -> list[str]:
    """Return the full names of the nodes in the parameter files of a component."""
    given = evaluate_parameters(visit.context, described.parameters or ())
    files = dict.fromkeys(one for one in given if isinstance(one, Path))
    found = dict.fromkeys(one.nodes for file in files for one in sections_in(file))
    return [nodes for nodes in found if "*" not in nodes]


def _values(parameters: Sequence[Any]) -> dict[str, Any]:
    """Return ROS parameters in messages as values of JSON."""
    found = {}
    for one in parameters:
        value = getattr(one.value, _FIELDS[one.value.type])
        found[one.name] = list(value) if isinstance(value, array) else value
    return found
