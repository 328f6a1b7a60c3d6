"""Components of containers: the slave loads them in order after each start and each restart.

The list of the container decides, not the history: so a component that a former run of this slave
has loaded is not loaded twice. The readiness time-out of the process bounds the whole work, because
a constructor may take long.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.slave import commands, events
from rosrm.core.slave.state import HeldInstance, Loading
from rosrm.core.slave.steps import NOTHING, Step
from rosrm.core.slave.watches import LoadedComponents
from rosrm.model.values import Assignment, qualified_name

#: Seconds between two requests for the list of a container that does not answer, or does not list
#: what it has loaded.
LIST_PERIOD: Final = 0.5


def loads_of(assignment: Assignment) -> LoadedComponents | None:
    """Return the components that the slave loads into an instance; None: none."""
    spec = assignment.spec
    if not spec.components:
        return None
    node = qualified_name(spec.namespace, assignment.node_name or spec.node)
    return LoadedComponents(f"{node}/_container", spec.components)


def begin(held: HeldInstance, loads: LoadedComponents, now: float) -> Step:
    """Request the list of a container that is in the graph."""
    held.loading = Loading(now)
    return _list(held, loads)


def listed(held: HeldInstance, event: events.ComponentsListed, _now: float) -> Step:
    """Load the next component that is missing in the list; without one the work is done."""
    loading, loads = held.loading, held.loads
    if loading is None or loads is None or loading.current is not None:
        return NOTHING
    missing = [one for one in loads.components if one.full_name not in event.names]
    if not missing:
        return Step(reached=True)
    new = [one for one in missing if one not in loading.answered]
    if not new:
        return NOTHING
    loading.current, status = new[0], held.status
    load = commands.LoadComponent(status.instance, status.pid, loads.services, new[0])
    return Step((load,))


def loaded(held: HeldInstance, event: events.ComponentLoaded, now: float) -> Step:
    """Take the answer to a load: the list follows, which has the component."""
    loading, loads = held.loading, held.loads
    if loading is None or loads is None or event.component != loading.current:
        return NOTHING
    if event.fault:
        name = event.component.full_name
        return Step(fault=f"the component {name} cannot be loaded: {event.fault}")
    loading.answered, loading.current = (*loading.answered, event.component), None
    loading.asked_at = now
    return _list(held, loads)


def time_passed(held: HeldInstance, now: float) -> Step:
    """Request the list again."""
    loading, loads = held.loading, held.loads
    if loading is None or loads is None or loading.current is not None:
        return NOTHING
    if now - loading.asked_at < LIST_PERIOD:
        return NOTHING
    loading.asked_at = now
    return _list(held, loads)


def lateness(held: HeldInstance) -> str:
    """Return what a container was still waiting for; "": it was not in the graph."""
    loading, loads = held.loading, held.loads
    if loading is None or loads is None:
        return ""
    if loading.current is not None:
        return f"the component {loading.current.full_name} was still being loaded"
    return f"{loads.services}/list_nodes did not list all components"


def _list(held: HeldInstance, loads: LoadedComponents) -> Step:
    status = held.status
    return Step((commands.ListComponents(status.instance, status.pid, loads.services),))
