"""Liveness of hosts: a silent host is first suspect (no new work), then, after its lease, lost.

A host whose slave was stopped and left processes running is detached instead. Its processes
follow the same lease (`host_loss`).

The master judges ages by its own clock alone, and never by the ROS graph. A host that
declares a long report period gets additional time for a few reports.
"""

from __future__ import annotations

from math import inf
from typing import Final

import numpy as np

from rosrm.core.master.assignment.assign import reconsider_set_aside
from rosrm.core.master.hosts import loss
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.model.event_kinds import EventKind

#: Number of its report periods for which a host may be silent before it is suspect.
_REPORTS_MISSED: Final = 3


def review_liveness(state: MasterState, now: float) -> None:
    """Move every host between up, suspect and lost by the age of its newest message."""
    table = state.hosts
    if not len(table):
        return
    age = now - table.last_contact
    condition = table.condition
    grace = _grace(state)
    fresh = age < state.settings.suspect + grace
    lease = state.settings.lease + grace
    gone = age >= lease
    up, suspect = condition == HostCondition.UP, condition == HostCondition.SUSPECT
    lost = condition == HostCondition.LOST
    # A host that left need not report, unless instances still run there. The lease of an expected
    # host begins at the start of this master.
    left = (condition == HostCondition.LEFT) & (table.processes > 0)
    watched = up | suspect | left | (condition == HostCondition.EXPECTED)
    past_lease = watched & gone
    lease_ends = table.last_contact + lease
    state.next_loss = float(lease_ends.min(initial=inf, where=watched & ~gone))
    for column in np.flatnonzero(up & ~fresh & ~past_lease):
        _suspect(state, table.hosts[column], float(age[column]), now)
    # A master that receives nothing from any host may itself be cut off.
    in_contact = (up & ~past_lease).any()
    state.contact_since = min(state.contact_since, now) if in_contact else inf
    for column in np.flatnonzero(past_lease):
        _lose(state, table.hosts[column], float(age[column]), float(lease[column]), now)
    for column in np.flatnonzero((suspect | lost) & fresh):
        mark_up(state, table.hosts[column], now)


def lease_of(state: MasterState, host: Host) -> float:
    """Return the seconds of silence after which a host is lost."""
    return state.settings.lease + float(_grace(state)[host.column])


def lease_end(state: MasterState, host: Host) -> float:
    """Return the time at which the lease of a host ends if it sends nothing before."""
    return float(state.hosts.last_contact[host.column]) + lease_of(state, host)


def _grace(state: MasterState) -> FloatArray:
    """Return the additional seconds, (H,), for which hosts that report seldom may be silent."""
    return np.maximum(0.0, _REPORTS_MISSED * state.hosts.period - state.settings.suspect)


def _suspect(state: MasterState, host: Host, age: float, now: float) -> None:
    state.hosts.set_condition(host, HostCondition.SUSPECT)
    state.record(
        now, EventKind.HOST_SUSPECT,
        f"{host.name} is suspect: it has not reported for {age:.1f} s and gets no new work",
        host=host.name,
    )  # fmt: skip


def _lose(state: MasterState, host: Host, age: float, lease: float, now: float) -> None:
    state.hosts.set_condition(host, HostCondition.LOST)
    state.record(
        now, EventKind.HOST_LOST,
        f"{host.name} is lost: it has not reported for {age:.1f} s, its lease is {lease:g} s",
        host=host.name,
    )  # fmt: skip
    loss.mark_lost(state, host, now)


def mark_up(state: MasterState, host: Host, now: float) -> None:
    """Return a suspect or lost host that reports again to the condition up."""
    was_lost = state.hosts.condition_of(host) is HostCondition.LOST
    state.hosts.set_condition(host, HostCondition.UP)
    state.record(now, EventKind.HOST_BACK, f"{host.name} reports again", host=host.name)
    if was_lost:
        loss.mark_rejoined(state, host, now)
        state.hosts.set_report_due(host, report_due=True)
        state.ask_for_report(host, now)
    reconsider_set_aside(state, now)
