"""Rules on the components that a slave loads into a container, and on those that are processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final

from rosrm.model.description_checks import is_namespace, is_node_name, node_name_fault
from rosrm.model.parameters import parameter_fault
from rosrm.model.values import ProcessSpec

#: Module of a process that stands for a component.
_PROCESS: Final = "rosrm.component"


def components_fault(spec: ProcessSpec) -> str:
    """Return why no slave can load the components of a process; "" if one can.

    A process that stands for one component names it in its arguments.
    """
    if spec.module == _PROCESS and (not spec.ros or len(spec.arguments) < 2):
        return (
            f"module: {_PROCESS} needs `ros: true` and `arguments: [CONTAINER, PLUGIN]`, as "
            "[box, 'my_robot.nodes:Counter']"
        )
    return next(_faults(spec), "") if spec.components else ""


def _faults(spec: ProcessSpec) -> Iterator[str]:
    if not spec.ros or not spec.node or not spec.awaits_graph:
        yield (
            "components: the slave loads them into a ROS node of a known name that is in the "
            "graph; set `ros: true`, and neither `node_name: keep` nor `readiness: running`"
        )
    if spec.lifecycle.is_managed:
        yield "components: a container has no lifecycle; leave out `lifecycle`"
    for one in spec.components:
        if not one.plugin:
            yield f"components: {one.name!r:.250} has no plugin, such as my_robot::Detector"
        if not is_node_name(one.name):
            yield f"components: {node_name_fault(one.name)}"
        for name, value in [*one.parameters.items(), *one.arguments.items()]:
            if fault := parameter_fault(name, value):
                yield f"components: {one.name}: {name}: {fault}"
        if one.namespace and not is_namespace(one.namespace):
            namespace = f"{one.namespace!r:.250}"
            yield f"components: {namespace} is not an absolute namespace such as '/robot1'"
    names = Counter(one.full_name for one in spec.components)
    for name in (name for name, count in names.items() if count > 1):
        yield f"components: {name} is there twice; give each node a name of its own"
