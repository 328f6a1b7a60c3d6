"""Placement filters: the rules by which hosts may take a process, with the reasons against a host.

`FILTERS` is the complete list. Each entry has a mask over many hosts, which a ranking reads, and
the reason against one host, which `rosrm explain` prints. A new rule is one more entry. The last
entry stands for the filters of plugins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

import numpy as np

from rosrm.core.master.scheduling import plugin_filters, proximity
from rosrm.core.master.scheduling.candidates import Candidates
from rosrm.core.master.scheduling.traffic import flow_view, keeping_limits
from rosrm.core.master.state.host_arrays import CAPACITY, LIMIT, LOAD, USAGE, BoolArray
from rosrm.core.master.state.hosts import HostCondition
from rosrm.wording import amount, by_reason, counted, listed

#: Tolerance in comparisons of sums of fractions.
_CLOSE: Final = 1e-9
#: Plain integers, because a comparison with an enum member takes twice the time.
_SUSPECT, _EXPECTED = int(HostCondition.SUSPECT), int(HostCondition.EXPECTED)
_FIRST_GONE: Final = int(HostCondition.LOST)


class Lasts(Enum):
    """Duration for which a host fails a filter."""

    MOMENT = "until a message or the end of a process changes it"
    RETURN = "until the slave reports to this run of the master, which is expected"
    AWAY = "until the host registers or rejoins, or a user uncordons it"
    NEIGHBOURS = "until an instance of another process starts, moves or ends"
    PERMANENT = "until the host reports other labels, resources, plugins or devices"


@dataclass(frozen=True, slots=True)
class Filter:
    """One placement rule.

    Attributes:
        name: unique.
        mask: (n,) True: the host passes. None: every host passes.
        reason: returns why the host of a row fails, as a predicate without the host's name, with
            the limiting setting if there is one. Called only for rows where `mask` is False.
        lasts: how long a host fails the filter. A process is set aside, and does not block the
            queue, if each host fails a permanent filter even as an empty host, or a rule on
            neighbours or links. A host that is away counts as failing, unless all hosts are away.
        by_assignment: True if an assignment changes the mask. Mask and reason then may read only
            the demand and the arrays of the candidates, because a decision copies those alone and
            formats the reason later.
        by_reading: True if a reading changes the mask.
        verdict: stands before the reason in an explanation.
    """

    name: str
    mask: Callable[[Candidates], BoolArray | None]
    reason: Callable[[Candidates, int], str]
    lasts: Lasts = Lasts.MOMENT
    by_assignment: bool = False
    by_reading: bool = False
    verdict: Literal["excluded", "full"] = "excluded"


@dataclass(frozen=True, slots=True)
class Refusal:
    """The first filter that a host fails, and why."""

    filter: Filter
    reason: str


def passing(
    filters: Iterable[Filter], hosts: Candidates, among: BoolArray | None = None
) -> BoolArray:
    """Return the mask of hosts (of all, or of those True in `among`) that pass the filters."""
    passes = among
    for one in filters:
        mask = one.mask(hosts)
        if mask is not None:
            passes = mask if passes is None else passes & mask
    return np.ones(len(hosts), np.bool_) if passes is None else passes


def refusals(filters: Iterable[Filter], hosts: Candidates) -> list[Refusal | None]:
    """Return for each host the first of the given filters that it fails."""
    found: list[Refusal | None] = [None] * len(hosts)
    for one in filters:
        mask = one.mask(hosts)
        for row in [] if mask is None else np.flatnonzero(~mask).tolist():
            found[row] = found[row] or Refusal(one, one.reason(hosts, row))
    return found


def first_of(one: Refusal | None, other: Refusal | None) -> Refusal | None:
    """Return the refusal whose filter comes first in the list."""
    both = [refusal for refusal in (one, other) if refusal is not None]
    return min(both, key=lambda refusal: FILTERS.index(refusal.filter), default=None)


# --- the process and the host -----------------------------------------------------------------


def _is_not_excluded(hosts: Candidates) -> BoolArray | None:
    if not hosts.demand.excluded:
        return None
    allowed = np.ones(len(hosts.table), np.bool_)
    for name in hosts.demand.excluded:
        host = hosts.table.by_name.get(name)
        if host is not None:
            allowed[host.column] = False
    return allowed[hosts.columns]


def _why_excluded(hosts: Candidates, row: int) -> str:
    return hosts.demand.excluded[hosts.host(row).name]


def _has_labels(hosts: Candidates) -> BoolArray | None:
    required = hosts.demand.spec.required_labels
    if not required:
        return None
    allowed = np.ones(len(hosts), np.bool_)
    for key, value in required.items():
        allowed &= hosts.table.labelled(key, value)[hosts.columns]
    return allowed


def _why_no_labels(hosts: Candidates, row: int) -> str:
    labels, required = hosts.host(row).description.labels, hosts.demand.spec.required_labels
    missing = [f"{key}={value}" for key, value in required.items() if labels.get(key) != value]
    return f"it lacks the label {', '.join(missing)}"


def _has_resources(hosts: Candidates) -> BoolArray | None:
    declared = hosts.demand.declared
    if not declared:
        return None
    if not declared.issubset(hosts.resources):
        return np.zeros(len(hosts), np.bool_)
    has_all: BoolArray = np.logical_and.reduce(hosts.need < np.inf)
    return has_all


def _why_no_resources(hosts: Candidates, row: int) -> str:
    needs = zip(hosts.resources, hosts.need[:, row].tolist(), strict=True)
    there = {name for name, need in needs if need < np.inf}
    return f"it has no {min(hosts.demand.declared - there)}"


def _can_enforce(hosts: Candidates) -> BoolArray | None:
    required, cpus = _to_enforce(hosts)
    if not required and not cpus:
        return None
    return hosts.table.enforcing(required, cpus)[hosts.columns]


def _why_not_enforced(hosts: Candidates, row: int) -> str:
    own, (required, cpus) = hosts.host(row).description, _to_enforce(hosts)
    lacking = [str(number) for number in cpus if own.cpus and number not in own.cpus]
    if lacking:
        return f"it has no CPU {listed(lacking)}; it has {listed(map(str, own.cpus))}"
    faults = ((name, own.unenforced[name]) for name in required if name in own.unenforced)
    return f"it cannot enforce {by_reason(faults)}"


def _to_enforce(hosts: Candidates) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the settings that a host must be able to enforce, and the CPUs that it must have."""
    spec = hosts.demand.spec
    return (spec.enforcement if spec.limits.enforce == "required" else ()), spec.cpus


def _has_launcher(hosts: Candidates) -> BoolArray | None:
    engine = hosts.demand.spec.container.engine
    return hosts.table.launching(engine)[hosts.columns] if engine else None


def _why_no_launcher(hosts: Candidates, row: int) -> str:
    return f"it does not offer {hosts.demand.spec.container.engine}"


# --- neighbours -------------------------------------------------------------------------------


def _keeps_neighbours(hosts: Candidates) -> BoolArray | None:
    kept = proximity.keeping_all(hosts.table, hosts.demand)
    return None if kept is None else kept[hosts.columns]


def _why_not_kept(hosts: Candidates, row: int) -> str:
    column = hosts.host(row).column
    return next(
        proximity.why_not_kept(hosts, row, rule)
        for rule in hosts.demand.neighbours
        if not rule.prefer and not proximity.keeping(hosts.table, rule)[column]
    )


# --- links of the host ------------------------------------------------------------------------


def _keeps_link_limits(hosts: Candidates) -> BoolArray | None:
    table = hosts.table
    kept = keeping_limits(table.links, hosts.demand.traffic, len(table), empty=hosts.empty)
    return None if kept is None else kept[hosts.columns]


def _why_over_link(hosts: Candidates, row: int) -> str:
    column = np.array([hosts.host(row).column])
    view = flow_view(hosts.table.links, hosts.demand.traffic, column, empty=hosts.empty)
    return view.describe(0, int(view.is_over()[0].argmax()))


# --- presence of the host ---------------------------------------------------------------------


def _is_not_gone(hosts: Candidates) -> BoolArray:
    return np.less(hosts.table.condition[hosts.columns], _FIRST_GONE)


def _is_not_expected(hosts: Candidates) -> BoolArray:
    return np.not_equal(hosts.table.condition[hosts.columns], _EXPECTED)


def _is_not_suspect(hosts: Candidates) -> BoolArray:
    return np.not_equal(hosts.table.condition[hosts.columns], _SUSPECT)


def _why_not_up(hosts: Candidates, row: int) -> str:
    return f"it {hosts.table.condition_of(hosts.host(row)).words()}"


def _is_open(hosts: Candidates) -> BoolArray:
    return ~hosts.table.closed[hosts.columns]


def _why_not_open(hosts: Candidates, row: int) -> str:
    return "it is being drained" if hosts.host(row).draining else "it is cordoned"


# --- reports of the host ----------------------------------------------------------------------


def _is_fresh(hosts: Candidates) -> BoolArray:
    return np.logical_not(hosts.table.stale[hosts.columns])


def _why_stale(hosts: Candidates, row: int) -> str:
    return f"its reading of {', '.join(hosts.table.stale_resources(hosts.host(row)))} is stale"


def _is_accepting(hosts: Candidates) -> BoolArray:
    return hosts.table.accepting[hosts.columns]


def _why_not_accepting(hosts: Candidates, row: int) -> str:
    over = hosts.table.over_limit(hosts.host(row).column)
    return f"it is over its limit of {', '.join(over)}" if over else "its slave accepts no work now"


def _has_reported(hosts: Candidates) -> BoolArray:
    return ~hosts.table.report_due[hosts.columns]


def _why_not_reported(hosts: Candidates, row: int) -> str:
    was = "did not answer an assignment" if hosts.host(row).unreached else "was lost"
    return f"it {was}, and has not reported its processes yet"


def _has_asked(hosts: Candidates) -> BoolArray:
    return hosts.table.asking[hosts.columns]


def _why_not_asked(_hosts: Candidates, _row: int) -> str:
    return "it has not requested work yet"


def _is_unclaimed(hosts: Candidates) -> BoolArray | None:
    claims, priority = hosts.table.claims, hosts.demand.spec.priority
    if not claims:
        return None
    allowed = np.ones(len(hosts.table), np.bool_)
    allowed[[column for column, claimed in claims.items() if priority < claimed]] = False
    return allowed[hosts.columns]


def _why_claimed(hosts: Candidates, row: int) -> str:
    claimed = hosts.table.claims[hosts.host(row).column]
    return f"room is being made there for a process of priority {claimed}"


# --- filters that an assignment changes -------------------------------------------------------


def _has_slot(hosts: Candidates) -> BoolArray:
    return hosts.processes < hosts.bound


def _why_no_slot(hosts: Candidates, row: int) -> str:
    most = counted(int(hosts.bound[row]), "process", "processes")
    return f"it accepts no more than {most} now"


def _has_devices(hosts: Candidates) -> BoolArray | None:
    return None if hosts.sets is None else hosts.sets > 0


def _why_no_devices(hosts: Candidates, row: int) -> str:
    inventory = hosts.inventories[row]
    return (inventory.emptied() if hosts.empty else inventory).why_not(hosts.demand.spec.devices)


def _has_room(hosts: Candidates) -> BoolArray:
    # A host without a resource has NaN there, which exceeds no limit.
    over = hosts.busy + hosts.need
    over -= hosts.cells[LIMIT]
    has_room: BoolArray = ~np.logical_or.reduce(over > _CLOSE - hosts.demand.headroom)
    return has_room


def _why_no_room(hosts: Candidates, row: int) -> str:
    limits = hosts.cells[LIMIT, :, row] - hosts.demand.headroom
    worst = int(np.nanargmax(hosts.busy[:, row] + hosts.need[:, row] - limits))
    name, limit = hosts.resources[worst], float(limits[worst])
    units = (one.unit for one in hosts.host(row).description.resources if one.name == name)
    unit, cells = next(units, ""), hosts.cells[:, worst, row]
    has, need, usable, used, reserved = (
        amount(float(part * cells[CAPACITY]), unit)
        for part in (1.0, hosts.need[worst, row], limit, cells[USAGE], cells[LOAD])
    )
    most = f"{usable} ({limit:.0%}) may be used"
    if hosts.empty:
        return f"it has {has} of {name}, of which {most}; needed: {need}"
    taken = f"{used} in use" + (f", {reserved} reserved" if cells[LOAD] else "")
    return f"{name}: needs {need}; at most {most}: {taken}"


# --- the list ---------------------------------------------------------------------------------

EXCLUSION: Final = Filter("exclusion", _is_not_excluded, _why_excluded, Lasts.PERMANENT)
NEIGHBOURS: Final = Filter("neighbours", _keeps_neighbours, _why_not_kept, Lasts.NEIGHBOURS)
LINKS: Final = Filter("links", _keeps_link_limits, _why_over_link, Lasts.NEIGHBOURS)
PLUGINS: Final = Filter(
    "plugins", plugin_filters.passing_plugins, plugin_filters.why_plugin_excludes, Lasts.PERMANENT,
    by_assignment=True,
)  # fmt: skip
#: In order: if a host fails several, the first one gives the reason.
FILTERS: Final = (
    EXCLUSION,
    Filter("labels", _has_labels, _why_no_labels, Lasts.PERMANENT),
    Filter("resources", _has_resources, _why_no_resources, Lasts.PERMANENT),
    Filter("container", _has_launcher, _why_no_launcher, Lasts.PERMANENT),
    Filter("enforcement", _can_enforce, _why_not_enforced, Lasts.PERMANENT),
    NEIGHBOURS,
    LINKS,
    Filter("gone", _is_not_gone, _why_not_up, Lasts.AWAY),
    Filter("expected", _is_not_expected, _why_not_up, Lasts.RETURN),
    Filter("cordon", _is_open, _why_not_open, Lasts.AWAY),
    Filter("suspect", _is_not_suspect, _why_not_up),
    Filter("processes", _has_slot, _why_no_slot, by_assignment=True),
    Filter("stale", _is_fresh, _why_stale, by_reading=True),
    Filter("limits", _is_accepting, _why_not_accepting, by_reading=True),
    Filter("report", _has_reported, _why_not_reported),
    Filter("request", _has_asked, _why_not_asked),
    Filter(
        "devices",
        _has_devices,
        _why_no_devices,
        Lasts.PERMANENT,
        by_assignment=True,
        verdict="full",
    ),
    Filter("claim", _is_unclaimed, _why_claimed),
    Filter("room", _has_room, _why_no_room, Lasts.PERMANENT, by_assignment=True, verdict="full"),
    PLUGINS,
)
#: Filters that a host may fail for lack of room alone.
OF_ROOM: Final = ("processes", "limits", "room")
STANDING: Final = tuple(one for one in FILTERS if not one.by_assignment)
#: Those of `STANDING` that neither an assignment nor a reading changes, and the others.
STEADY: Final = tuple(one for one in STANDING if not one.by_reading)
BY_READING: Final = tuple(one for one in STANDING if one.by_reading)
BY_ASSIGNMENT: Final = tuple(one for one in FILTERS if one.by_assignment)
