"""Feasibility: the hosts that may ever take a process. A process without one is set aside."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates, as_if_empty
from rosrm.core.master.scheduling.filters import (
    EXCLUSION,
    FILTERS,
    LINKS,
    NEIGHBOURS,
    Lasts,
    Refusal,
    passing,
    refusals,
)
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.devices import DeviceNeeds
from rosrm.core.master.state.host_arrays import BoolArray
from rosrm.core.master.state.hosts import HostCondition, HostTable
from rosrm.model.values import ProcessSpec
from rosrm.wording import by_reason, counted, first_line, get_close_matches, listed

#: Largest number of hosts that a reason names.
_NAMED_HOSTS: Final = 16

_PERMANENT: Final = tuple(one for one in FILTERS if one.lasts is Lasts.PERMANENT)
_AWAY: Final = tuple(one for one in FILTERS if one.lasts is Lasts.AWAY)
_ABSENT: Final = tuple(one for one in FILTERS if one.lasts in (Lasts.AWAY, Lasts.RETURN))
_CHANGING: Final = (
    EXCLUSION,
    *(one for one in FILTERS if one.lasts not in (Lasts.PERMANENT, Lasts.MOMENT)),
)


def why_never(table: HostTable, demand: Demand) -> str:
    """Return why no host may take a process before a lasting change; "" if one may.

    An absent host does not count while another host is present, because a process that waits for an
    absent host must not block the queue.
    """
    if not len(table) or possible(table, demand).any():
        return ""
    unknown = (
        _unmeasured(table, demand) or _unknown_device(table, demand) or _no_engine(table, demand)
    )
    if unknown:
        return unknown
    alone = "; there is no other host" if len(table.listed()) == 1 else ""
    return _host_by_host(_longest_refusals, table, demand) + alone


def _longest_refusals(hosts: Candidates) -> list[Refusal | None]:
    """Return for each host the refusal that holds longest.

    The resources of a host without a reading may be unknown; so its absence comes first.
    """
    pairs = zip(refusals(_PERMANENT, hosts), refusals(_CHANGING, hosts), strict=True)
    unread = hosts.table.without_reading()[hosts.columns]
    return [
        changing or permanent if unknown else permanent or changing
        for (permanent, changing), unknown in zip(pairs, unread, strict=True)
    ]


def a_known_host_may(table: HostTable, demand: Demand) -> bool:
    """Return True if a host whose limits are known may take a demand."""
    return bool((possible(table, demand) & ~table.without_reading()).any())


def refused_everywhere(table: HostTable, demand: Demand) -> bool:
    """Return True if every host that might have taken the process has refused it."""
    if not demand.excluded:
        return False
    allowed = Demand(demand.spec, demand.amounts, demand.estimated, plugins=demand.plugins)
    might = may_ever_take(table, allowed)
    return all(table.hosts[column].name in demand.excluded for column in np.flatnonzero(might))


def may_ever_take(table: HostTable, demand: Demand) -> BoolArray:
    """Return a mask, (H,), of the hosts that fit a demand if nothing else runs there.

    A host without a reading counts, because its limits are not known yet; a pruned one does not.
    """
    return _fit_empty(_every(table, demand))


def why_all_away(table: HostTable, demand: Demand) -> str:
    """Return why each host is away; "" if one of them is present."""
    if passing(_ABSENT, _every(table, demand)).any():
        return ""
    reasons = _host_by_host(partial(refusals, _ABSENT), table, demand)
    return f"every host is away: {reasons}"


def why_each_never(
    table: HostTable, demand: Demand, columns: Sequence[int]
) -> list[tuple[str, str]]:
    """Return the name of each of these hosts that may never take a demand, and why."""
    hosts = as_if_empty(table, demand, np.array(columns, np.int64))
    found = refusals(_PERMANENT, hosts)
    return [
        (hosts.host(row).name, first_line(refusal.reason))
        for row, refusal in enumerate(found)
        if refusal is not None
    ]


def _every(table: HostTable, demand: Demand) -> Candidates:
    return as_if_empty(table, demand, slice(0, len(table)))


def _fit_empty(hosts: Candidates) -> BoolArray:
    table = hosts.table
    is_listed = table.condition != HostCondition.LEFT  # read for hosts without a reading
    return np.where(table.without_reading(), is_listed, passing(_PERMANENT, hosts))


def possible(table: HostTable, demand: Demand) -> BoolArray:
    """Return a mask, (H,), of the hosts that may take a demand before a lasting change."""
    hosts = _every(table, demand)
    possible = _fit_empty(hosts) & passing([EXCLUSION, NEIGHBOURS, LINKS], hosts)
    there = passing(_AWAY, hosts)
    return possible & there if there.any() else possible


def _host_by_host(
    refused: Callable[[Candidates], list[Refusal | None]], table: HostTable, demand: Demand
) -> str:
    """Return the reason against each host, equal ones once."""
    listed = table.listed()
    named = listed[:_NAMED_HOSTS]
    columns = np.array([host.column for host in named], np.int64)
    found = refused(as_if_empty(table, demand, columns))
    summary = by_reason(
        (host.name, first_line(refusal.reason))  # `rosrm explain` has the details
        for host, refusal in zip(named, found, strict=True)
        if refusal is not None
    )
    more = len(listed) - len(named)
    return f"{summary}; and {counted(more, 'more host')}" if more else summary


def unknown_resources(table: HostTable, specs: Iterable[ProcessSpec]) -> list[str]:
    """Return a sentence on each needed resource that no host reports; [] without any host."""
    needed = {name for spec in specs for name in spec.needs}
    return [_unknown(name, table) for name in sorted(needed - set(table.resources)) if len(table)]


def _unmeasured(table: HostTable, demand: Demand) -> str:
    """Return a sentence on a resource that no host reports, with a near name; "": none."""
    unknown = sorted(demand.declared - set(table.resources))
    return _unknown(unknown[0], table) if unknown else ""


def _unknown(resource: str, table: HostTable) -> str:
    near = get_close_matches(resource, table.resources, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    there = ", ".join(sorted(table.resources)) or "none"
    return f"no host reports the resource {resource!r}{hint} (reported: {there})"


def _unknown_device(table: HostTable, demand: Demand) -> str:
    """Return a sentence on a kind of devices that no host has, with a near name; "": none."""
    there = table.devices.kinds()
    for need in demand.spec.devices:
        if need.kind not in there:
            near = get_close_matches(need.kind, there, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            return f"no host has a {need.kind!r} among its devices{hint} (there: {listed(there)})"
    return ""


def why_no_devices(table: HostTable, needs: DeviceNeeds) -> str:
    """Return which instances hold the devices that a process needs; "": a host has free ones.

    The first 16 hosts with such devices count.
    """
    held: list[tuple[str, str]] = []
    for host in table.listed() if needs else ():
        inventory = table.devices[host.column]
        if inventory.choose(needs) is not None:
            return ""
        if inventory.emptied().choose(needs) is not None:
            held.append((host.name, inventory.why_not(needs)))
        if len(held) == _NAMED_HOSTS:
            break
    return by_reason(held)


def _no_engine(table: HostTable, demand: Demand) -> str:
    """Return a sentence on an engine of containers that no host offers; "": none."""
    engine = demand.spec.container.engine
    if not engine or table.launching(engine).any():
        return ""
    there = {name for host in table.hosts for name in host.description.launchers}
    others = f" (only {listed(sorted(there))})" if there else ""
    return (
        f"no host offers {engine} for containers{others}: install {engine} and its plugin on a "
        f"host, and restart the slave"
    )
