"""Hosts near a process or apart from it: masks, the term of preferred rules, and reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates
from rosrm.core.master.state.demand import Demand, Neighbour
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray
from rosrm.core.master.state.hosts import Host, HostTable
from rosrm.wording import listed

#: Added to the score for each neighbour that a host should be near or apart from, and is not. It is
#: as large as the score of a full host by Eq. 1.
TERM: Final = 1.0


def keeping_all(table: HostTable, demand: Demand) -> BoolArray | None:
    """Return the mask, (H,), of the hosts that keep each required rule; None: there are none."""
    kept = [keeping(table, rule) for rule in demand.neighbours if not rule.prefer]
    if not kept:
        return None
    allowed: BoolArray = np.logical_and.reduce(kept)
    return allowed


def keeping(table: HostTable, neighbour: Neighbour) -> BoolArray:
    """Return the mask, (H,), of the hosts that keep a rule.

    No host keeps a rule `apart` by a label while the label of the other instance's host is unknown.
    """
    if neighbour.relation == "apart" and _unknown_host(table, neighbour):
        return np.zeros(len(table), np.bool_)
    beside = _beside_any(table, neighbour)
    if neighbour.relation == "near":
        return beside
    return ~(beside | table.labelled(neighbour.by, None)) if neighbour.by else ~beside


def preference(table: HostTable, demand: Demand) -> FloatArray | None:
    """Return the term, (H,), of the preferred rules in the score; None: there are none."""
    term: FloatArray | None = None
    for neighbour in demand.neighbours:
        if neighbour.prefer and neighbour.at:
            unmet = _unmet(table, neighbour)
            term = TERM * unmet if term is None else term + TERM * unmet
    return term


def _unmet(table: HostTable, neighbour: Neighbour) -> FloatArray:
    """Return the number of instances, (H,), near or apart from which a host should be, and is not.

    Of a rule "near", which has one instance: 0 or 1.
    """
    if neighbour.relation == "apart":
        return _count(table, neighbour)
    return np.where(_beside_any(table, neighbour), 0.0, 1.0)


def why_not_kept(hosts: Candidates, row: int, neighbour: Neighbour) -> str:
    """Return a predicate: why a host does not keep a hard rule."""
    host, by = hosts.host(row), neighbour.by
    if neighbour.absent:
        return neighbour.absent
    others = listed(_names(neighbour.at))
    if neighbour.relation == "near":
        where = " or ".join(sorted({_place(hosts.table, name, by) for name, _ in neighbour.at}))
        return f"{others}, near which the process must run, runs on {where}"
    unknown = _unknown_host(hosts.table, neighbour)
    if unknown:
        them = listed(name for at, name in neighbour.at if at == unknown)
        return (
            f"the label {by!r} of {unknown}, the host of {them}, apart from which the process must "
            f"run, is not known until it reports"
        )
    beside = listed(_names(_beside(hosts.table, host, neighbour)))
    if not by:
        return f"it runs {beside}, apart from which the process must run"
    value = host.description.labels.get(by)
    if value is None:
        return f"it has no label {by!r}, by which the process must run apart from others"
    return f"it has {by}={value}, as the host of {beside}, apart from which the process must run"


def unmet(hosts: Candidates, row: int) -> str:
    """Return a phrase on each preferred rule that adds to the score of a host; "": none."""
    host, phrases = hosts.host(row), []
    for neighbour in hosts.demand.neighbours:
        if not neighbour.prefer or not neighbour.at:
            continue
        beside = _beside(hosts.table, host, neighbour)
        if neighbour.relation == "near" and not beside:
            phrases.append(f"+{TERM:g}: not near {listed(_names(neighbour.at))}")
        elif neighbour.relation == "apart" and beside:
            phrases.append(f"+{TERM * len(beside):g}: not apart from {listed(_names(beside))}")
    return "; ".join(phrases)


def _unknown_host(table: HostTable, neighbour: Neighbour) -> str:
    """Return the host of an instance whose place by a label is not known; "": all are known."""
    return table.with_unknown_label(name for name, _ in neighbour.at) if neighbour.by else ""


def _beside_any(table: HostTable, neighbour: Neighbour) -> BoolArray:
    """Return the mask, (H,), of the hosts of the instances, or of their places by the label."""
    found = np.zeros(len(table), np.bool_)
    if not neighbour.by:
        found[_columns(table, neighbour)] = True
    for place in _places(table, neighbour) if neighbour.by else ():
        found |= table.labelled(neighbour.by, place)
    return found


def _count(table: HostTable, neighbour: Neighbour) -> FloatArray:
    """Return the number of instances, (H,), on each host or in its place by the label."""
    found = np.zeros(len(table))
    if not neighbour.by:
        np.add.at(found, _columns(table, neighbour), 1.0)
    for place, many in _places(table, neighbour).items() if neighbour.by else ():
        found += many * table.labelled(neighbour.by, place)
    return found


def _columns(table: HostTable, neighbour: Neighbour) -> list[int]:
    hosts = table.by_name
    return [hosts[name].column for name, _ in neighbour.at if name in hosts]


def _places(table: HostTable, neighbour: Neighbour) -> Counter[str]:
    """Return the number of instances by the value of the label of their hosts."""
    values = (_value(table, name, neighbour.by) for name, _ in neighbour.at)
    return Counter(value for value in values if value is not None)


def _beside(table: HostTable, host: Host, neighbour: Neighbour) -> list[tuple[str, str]]:
    """Return the instances of a neighbour on a host or in its place by the label."""
    here = _value(table, host.name, neighbour.by)
    if here is None:
        return []
    return [one for one in neighbour.at if _value(table, one[0], neighbour.by) == here]


def _value(table: HostTable, name: str, by: str) -> str | None:
    """Return the place of a host by a label; None: it has none."""
    host = table.by_name.get(name)
    if host is None or not by:
        return None if host is None else name
    return host.description.labels.get(by)


def _place(table: HostTable, name: str, by: str) -> str:
    value = _value(table, name, by)
    return f"{name} with {by}={value}" if by and value is not None else name


def _names(at: Iterable[tuple[str, str]]) -> list[str]:
    return list(dict.fromkeys(process for _, process in at))


def same_place(one: Host, other: Host, by: str) -> bool:
    """Return True if two hosts are one place by a label; without a label if they are one host."""
    if not by:
        return one is other
    value = one.description.labels.get(by)
    return value is not None and value == other.description.labels.get(by)
