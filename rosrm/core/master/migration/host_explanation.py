"""Explanation of a host that processes have to leave: over a limit, or being drained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.eviction import PlannedMoves, departures, evictions
from rosrm.core.master.migration.start import moves_under_way
from rosrm.core.master.state.hosts import Host
from rosrm.wording import by_reason, duration, listed, percent


def host_explanation(state: MasterState, name: str, now: float) -> Mapping[str, Any] | None:
    """Return why processes have to leave a host, and why they do not; None: no such host."""
    host = state.hosts.by_name.get(name)
    if host is None or host.pruned:
        return None
    return {
        "of_host": name,
        "over": {resource: now - since for resource, since in host.over_since.items()},
        "reasons": [*_about_drain(state, host, now), *_about_limits(state, host, now)],
    }


def _about_drain(state: MasterState, host: Host, now: float) -> Iterator[str]:
    if not host.draining:
        return
    progress = "is drained" if host.drained else "is being drained"
    text = f"{host.name} {progress}: {departures(state, host, now)}"
    if state.instances_of(host):
        text += (
            f"; `rosrm cancel NAME` ends a process there, and `rosrm uncordon {host.name}` ends "
            f"the drain"
        )
    yield text


def _about_limits(state: MasterState, host: Host, now: float) -> Iterator[str]:
    for resource, since in host.over_since.items():
        at = state.hosts.resources.index(resource)
        usage, limit = state.hosts.usage[at, host.column], state.hosts.limit[at, host.column]
        amounts = f"{percent(float(usage))} % of at most {percent(float(limit))} %"
        yield (
            f"{host.name} is over its limit of {resource} ({amounts}, for {duration(now - since)}):"
            f" {_effect(state, host, resource, since, now)}"
        )


def _effect(state: MasterState, host: Host, resource: str, since: float, now: float) -> str:
    """Return which process moves because of an exceeded limit, or why none does."""
    moving = [name for name, one in state.migrations.items() if one.source_host is host]
    if moving:
        return f"{listed(moving)} {'is' if len(moving) == 1 else 'are'} being moved away"
    if host.draining:
        return "its drain moves the processes that can leave"
    reasons = []
    for name, planned in evictions(state, host, resource, now):
        if isinstance(planned, PlannedMoves):
            return f"{name} can move to {planned.destination.name}, {_when(state, since, now)}"
        predicate = planned.reason.removeprefix(f"{name} ")
        sentence = planned.reason if predicate == planned.reason else f"it {predicate}"
        reasons.append((name or "all processes", sentence))
    if not reasons:
        return (
            "it runs no process of this cluster, so other programs on it use it; end those, or "
            "raise the limit"
        )
    advice = (
        f"cancel a process (`rosrm ps --host {host.name}`), let one move (`migration` in its file),"
        f" raise the limit, or add a host"
    )
    return f"nothing can leave it: {by_reason(reasons)}. To lower its usage, {advice}"


def _when(state: MasterState, since: float, now: float) -> str:
    """Return when the master moves a process that can leave a host over a limit."""
    settings = state.settings
    if not settings.automatic:
        return "by `rosrm migrate`, because `migration.automatic` is off"
    if moves_under_way(state) >= settings.max_migrations:
        return f"after another move (`migration.max_in_flight` is {settings.max_migrations})"
    return f"after {settings.hysteresis:g} s over the limit (`migration.hysteresis`)"
