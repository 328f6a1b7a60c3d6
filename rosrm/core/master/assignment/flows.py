"""Flows of a process with the current hosts of the other processes.

A flow counts from the time at which both of its processes have a host. Only then it has a part in
the load of a link, and in the choice of a host for one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from math import isnan
from typing import Any, Final

import numpy as np

from rosrm.core.master.assignment.neighbours import binds, host_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.scheduling.traffic import rates, round_trips
from rosrm.core.master.state.demand import NO_TRAFFIC, Flow, Traffic
from rosrm.core.master.state.flows import pair_of
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.links import Crossing
from rosrm.core.master.state.process import Process

#: Most flows in an explanation.
_MOST_DESCRIBED: Final = 64
_NONE: Final = frozenset[str]()


def traffic_of(
    state: MasterState, process: Process, *, together: AbstractSet[str] = _NONE
) -> Traffic:
    """Return the flows between a process and others that have a host.

    `together`: processes that move with it to one host; flows between them cross no link.
    """
    count_flows(state)
    partners = state.flows.partners.get(process.name)
    if not partners:
        return NO_TRAFFIC
    links = state.hosts.links
    pairs = (pair_of(process.name, other) for other in partners)
    counted = (links.crossings[pair] for pair in pairs if pair in links.crossings)
    flows = tuple(_flows(state, process.name, together))
    return Traffic(flows, tuple(counted), links.version) if flows else NO_TRAFFIC


def _flows(state: MasterState, name: str, together: AbstractSet[str]) -> Iterator[Flow]:
    for other in state.flows.partners[name]:
        bound = binds(state, other, name)
        host, flow = _host(state, other), state.flows.between(name, other, bound=bound)
        if host is not None and other not in together and flow.rate > 0.0:
            yield Flow(other, host.name, host.column, flow.rate, flow.incoming, flow.learned)


def count_flows(state: MasterState) -> None:
    """Update the load of the links after changes of flows and of the hosts of their processes."""
    changed, links = state.flows.changed, state.hosts.links
    if not changed:
        return
    state.flows.changed = {}
    for name, other in changed:
        links.note((name, other), _crossing(state, name, other))


def _crossing(state: MasterState, name: str, other: str) -> Crossing | None:
    """Return the flow between the hosts of two processes; None: it crosses no link."""
    here, there = _host(state, name), _host(state, other)
    rate = state.flows.between(name, other).rate
    if here is None or there is None or here is there or rate <= 0.0:
        return None
    return Crossing(here.column, there.column, rate)


def joined(one: Traffic, other: Traffic) -> Traffic:
    """Return the flows of two processes that are placed on one host."""
    if not (one.flows and other.flows):
        return one if one.flows else other
    counted = tuple(dict.fromkeys((*one.counted, *other.counted)))
    return Traffic((*one.flows, *other.flows), counted, one.version)


def _host(state: MasterState, name: str) -> Host | None:
    """Return the host of a process, also while it moves; None: it has none."""
    process = state.processes.get(name)
    owner = state.owner_of(process) if process is not None else None
    return owner.host if owner is not None else None


def _link(
    state: MasterState, here: Host | None, there: Host | None
) -> tuple[float | None, float | None]:
    """Return round trip and rate of the link between two hosts; None: there is none, or unknown."""
    if here is None or there is None or here is there:
        return None, None
    links, ends = state.hosts.links, (np.array([here.column]), np.array([there.column]))
    found = (float(values(links, *ends)[0, 0]) for values in (round_trips, rates))
    trip, rate = (None if isnan(value) else value for value in found)
    return trip, rate


def described_flows(state: MasterState, process: Process) -> Mapping[str, Any]:
    """Return the largest flows of a process for `explain`, also those that do not count yet."""
    flows = {
        other: state.flows.between(process.name, other)
        for other in state.flows.partners.get(process.name, ())
    }
    largest = sorted(flows, key=lambda other: -flows[other].rate)[:_MOST_DESCRIBED]
    rows: list[Mapping[str, Any]] = []
    here = _host(state, process.name)
    for other in largest:
        flow, host = flows[other], _host(state, other)
        trip, rate = _link(state, here, host)
        rows.append(
            {
                "process": other, "rate": flow.rate, "incoming": flow.incoming,
                "host": "" if host is None else host.name, "learned": flow.learned,
                "round_trip": trip, "link_rate": rate,
                "reason": host_of(state, other)[1] if host is None else "",
            }
        )  # fmt: skip
    return {"flows": rows, "flows_omitted": len(flows) - len(rows)}
