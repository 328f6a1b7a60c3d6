"""Measurement of links between hosts, and of the flows of processes, by orders to slaves.

==============================  =============================================================
observed                        action
==============================  =============================================================
`link_period` after the last    `MeasureLinks` with the next peers of the host; one host in
measurement of a host           each tick, and at most PROBES peers a second in all
the slave has answered          the report replaces what was known of the host; impossible
                                entries are left out and recorded; a flow that is not
                                reported for `LEARNED_FOR` stops counting
no answer in time               the order is repeated after `link_period`
the slave refuses the order     the order is repeated, with back-off
==============================  =============================================================

Nothing is persisted: slaves measure again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.pending_orders import LinkMeasurement
from rosrm.model.event_kinds import EventKind
from rosrm.model.links import LinkPeer, LinkReport, report_from_json
from rosrm.model.orders import MeasureLinks
from rosrm.model.values import EMPTY, qualified_name
from rosrm.wording import counted, few

#: Most peers of one measurement, and most peers in a second of all measurements.
_PEERS: Final = 4
PROBES: Final = 4.0


def ask_next_host(state: MasterState, now: float) -> None:
    """Order the next measurement that is due."""
    queries, period = state.link_queries, state.settings.link_period
    name = queries.take_due(now) if period else None
    if name is None:
        return
    queries.add(name, now + period)
    host = state.hosts.up(name)
    if host is None:
        return
    allowed = min(_PEERS, max(1, int(min(now - queries.probed_at, 1.0) * PROBES)))
    peers = tuple(_peers(state, name, allowed))
    if peers:
        queries.probed_at = now
    state.send(host, MeasureLinks(peers, state.settings.learn_flows), LinkMeasurement(name))


def _peers(state: MasterState, host: str, most: int) -> list[LinkPeer]:
    there = ((state.hosts.up(name), name) for name in state.link_queries.peers(host, most))
    places = state.link_queries.places
    return [LinkPeer(one.host_id, name, *places[name]) for one, name in there if one is not None]


def note_answer(state: MasterState, name: str, event: happened.OrderAnswered, now: float) -> None:
    """Store the report of a host."""
    host = state.hosts.up(name)
    if host is None:
        return
    if not event.accepted:
        if event.outcome is not OrderOutcome.TIMEOUT:
            state.link_queries.note_refusal(name, now, state.settings.link_period)
        return
    state.link_queries.note_success(name)
    try:
        report, faults = report_from_json(event.result or EMPTY)
    except ValueError as fault:
        why = f"a report of {name} on its links was refused: {fault}"
        state.record_seldom(host, EventKind.READING_REFUSED, now, why)
        return
    if faults:
        entries, reasons = counted(len(faults), "entry", "entries"), "; ".join(few(faults, 3))
        why = f"{entries} left out of a report of {name} on its links: {reasons}"
        state.record_seldom(host, EventKind.READING_REFUSED, now, why)
    note_report(state, host, report, now)


def note_report(state: MasterState, host: Host, report: LinkReport, now: float) -> None:
    """Store what a host has measured."""
    table = state.hosts
    if report.port:
        state.link_queries.places[host.name] = (report.addresses, report.port)
    peers = {
        host_id - 1: measured for host_id, measured in report.peers.items()
        if 0 < host_id <= len(table) and host_id != host.host_id
    }  # fmt: skip
    table.links.store(host.column, report.interfaces, report.limit, peers)
    _learn(state, host, report.flows, now)
    table.changed()


def _learn(
    state: MasterState, host: Host, flows: Mapping[int, Mapping[str, float]], now: float
) -> None:
    """Store what the processes of a host receive from others."""
    received = _received(state, host, flows) if flows else {}
    for name in {**received, **state.flows.learned}:
        owner = state.owner_of(state.processes[name])
        if owner is not None and owner.host is host:
            state.flows.learn(name, received.get(name, EMPTY), now, owner.since)


def _received(
    state: MasterState, host: Host, flows: Mapping[int, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Return what the processes of a host receive from nodes, by the processes of the nodes."""
    nodes, found = _process_of_node(state), dict[str, dict[str, float]]()
    for number, rates in flows.items():
        instance = state.instances.get(number)
        process = state.owned_by(instance) if instance is not None else None
        if instance is None or process is None or instance.host is not host:
            continue
        received = found.setdefault(process.name, {})
        for node, rate in rates.items():
            sender = nodes.get(node, process.name)
            if sender != process.name and rate > 0.0:
                received[sender] = received.get(sender, 0.0) + rate
    return found


def _process_of_node(state: MasterState) -> dict[str, str]:
    """Return the process of each node that the processes with an owner bring into the graph."""
    nodes = {}
    for process in state.processes.values():
        owner = state.owner_of(process)
        name = "" if owner is None else owner.node_name or process.spec.node
        if name and process.spec.ros:
            nodes[qualified_name(process.spec.namespace, name)] = process.name
    return nodes
