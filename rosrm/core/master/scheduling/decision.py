"""Why this host and not the others: the outcome of a ranking, with its reasons.

Many decisions are made and few are read, so a decision copies what was known of the few hosts that
it names, and spells its verdicts out when somebody reads them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rosrm.core.master.scheduling.ranking import (
    CLOSE,
    TIE,
    Labels,
    NamedPolicy,
    Names,
    Ranking,
    eligible,
)
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.host_arrays import (
    BUSY,
    CAPACITY,
    LIMIT,
    LOAD,
    USAGE,
    BoolArray,
    FloatArray,
    IntArray,
)
from rosrm.core.master.state.hosts import Host, HostCondition, HostTable
from rosrm.core.master.state.lazy import Lazy
from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.extensions.declared_fields import declared_spec
from rosrm.extensions.plugin_calls import PluginCalls, required
from rosrm.model.values import EMPTY
from rosrm.wording import amount, by_reason, counted, first_line, get_close_matches, one_line

#: An explanation names every host up to this many, else the best of those that fit.
_NAMED_HOSTS: Final = 16


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was found of one host.

    Attributes:
        verdict: "chosen", "fits", "full", "vetoed" or "excluded".
        score: where it fits.
    """

    host: str
    verdict: str
    score: float | None
    reason: str

    def to_json(self) -> dict[str, Any]:
        """As it stands in the event record."""
        return {
            "name": self.host, "verdict": self.verdict, "score": self.score, "reason": self.reason,
        }  # fmt: skip


@dataclass(slots=True)  # not frozen: that costs a microsecond for each of thousands
class Moment:
    """What was known of n hosts when a decision was made; copies, which change no more.

    Attributes:
        columns: (n,) of the hosts; a column stays with its host.
        closed: why each could not be given work, its room aside; "" if it could; (): all could.
        cells: (planes, R, n) as in `HostColumns`.
        need: (R, n) fractions.
        value: (n,) score plus tie-break; inf where it did not fit.
        plugins: guards the calls of the policy.
        processes: (n,) held or promised.
    """

    demand: Demand
    policy: NamedPolicy | None
    plugins: PluginCalls
    table: HostTable
    resources: tuple[str, ...]
    columns: IntArray
    closed: tuple[str, ...]
    cells: FloatArray
    need: FloatArray
    value: FloatArray
    processes: IntArray

    def scores(self) -> Scores | None:
        """The policy's judgement once more (it is pure), for its reasons; None: it has none."""
        if self.policy is None or not len(self.columns):
            return None
        hosts = HostView(
            Names(self.table, self.columns), self.resources, self.cells[BUSY].T,
            self.cells[LIMIT].T, self.cells[CAPACITY].T, self.processes,
            Labels(self.table, self.columns),
        )  # fmt: skip
        spec = declared_spec(self.demand.spec, self.demand.reads)
        (name, policy), process = self.policy, ProcessView(spec, self.need.T)
        try:
            return self.plugins.ask(
                "scoring", name, "score", lambda: required(policy.score(hosts, process), Scores)
            )
        except PluginError:
            return None  # the decision is made already


class Decision(Lazy):
    """The outcome for one process; as a mapping, it is what stands in the event record.

    Attributes:
        kind: "assigned", "waits", "migrated", "stayed" (it was to move, and did not), ...
        column: of the chosen host; -1: none fits now.
        policy: name of the policy that decided, and which was left out.
        needs: base units by resource.
        omitted: how many hosts had which verdict beside those that are named.
    """

    __slots__ = ("_moment", "column", "kind", "omitted", "policy")

    def __init__(
        self, column: int, policy: str, moment: Moment, omitted: Mapping[str, int]
    ) -> None:
        super().__init__()
        self.kind = ""
        self.column = column
        self.policy = policy
        self.omitted = omitted
        self._moment = moment

    @property
    def needs(self) -> Mapping[str, float]:
        """Base units by resource."""
        return self._moment.demand.amounts

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Of up to 16 hosts; the chosen one first."""
        scores = self._moment.scores()
        return tuple(
            _verdict(self._moment, scores, at, chosen=self.column >= 0 and at == 0)
            for at in range(len(self._moment.columns))
        )

    def render(self) -> Mapping[str, Any]:
        """As it stands in the event record."""
        verdicts = self.verdicts
        return {
            "kind": self.kind,
            "policy": self.policy,
            "chosen": verdicts[0].host if self.column >= 0 else None,
            "need": dict(self.needs),
            "hosts": [verdict.to_json() for verdict in verdicts],
            "omitted": dict(self.omitted),
        }


def decide(ranking: Ranking, *, chosen: int | None = None) -> Decision:
    """The outcome of a ranking with its reasons.

    Args:
        ranking: refreshed.
        chosen: column decided elsewhere, -1: none; None: the best.
    """
    column = ranking.best() if chosen is None else chosen
    listed = [host.column for host in ranking.table.listed()]
    if len(listed) <= _NAMED_HOSTS:
        moment = _moment(ranking, _first(column, listed))
        return Decision(column, ranking.policy_name, moment, EMPTY)
    # Of many hosts only those that were nearly chosen are of interest, and time is short.
    nearly = ranking.lowest() if column >= 0 else listed[:_NAMED_HOSTS]
    moment = _moment(ranking, _first(column, nearly))
    named, fitting = len(moment.columns), int(np.count_nonzero(ranking.value < np.inf))
    named_fitting = sum(value < np.inf for value in moment.value.tolist())
    omitted = {
        "would take it at a higher score": fitting - named_fitting,
        "cannot take it now": len(listed) - fitting - (named - named_fitting),
    }
    return Decision(column, ranking.policy_name, moment, omitted)


def _first(column: int, columns: Sequence[int]) -> list[int]:
    """The columns, the chosen one first; one that is none of them takes the last one's place."""
    if column < 0:
        return list(columns)
    others = [other for other in columns if other != column]
    return [column, *(others[:-1] if len(others) == len(columns) else others)]


def verdict_of(ranking: Ranking, column: int) -> Verdict:
    """What is found of one host."""
    moment = _moment(ranking, [column])
    return _verdict(moment, moment.scores(), 0, chosen=False)


def _moment(ranking: Ranking, columns: list[int]) -> Moment:
    table, at = ranking.table, np.array(columns, np.int64)
    value = ranking.value[at]
    closed: tuple[str, ...] = ()
    if np.inf in value.tolist():
        closed = tuple(
            "" if ranking.fits(column) else _why_closed(table, ranking.demand, column)
            for column in columns
        )
    return Moment(
        ranking.demand, ranking.judge, ranking.plugins, table, table.resources, at, closed,
        table.cells[:, :, at], ranking.need[:, at], value, table.processes[at],
    )  # fmt: skip


def _why_closed(table: HostTable, demand: Demand, column: int) -> str:
    return _exclusion(table, demand, column) or table.why_closed(column)


def _exclusion(table: HostTable, demand: Demand, column: int) -> str:
    host = table.hosts[column]
    if host.name in demand.excluded:
        return demand.excluded[host.name]
    labels = host.description.labels
    missing = {k: v for k, v in demand.spec.required_labels.items() if labels.get(k) != v}
    if missing:
        return "it lacks the label " + ", ".join(f"{key}={value}" for key, value in missing.items())
    for resource in sorted(demand.declared):
        row = table.resources.index(resource) if resource in table.resources else -1
        if row < 0 or not table.capacity[row, column] > 0.0:
            return f"it has no {resource}"
    return ""


def _verdict(moment: Moment, scores: Scores | None, at: int, *, chosen: bool) -> Verdict:
    name, value = moment.table.hosts[moment.columns[at]].name, float(moment.value[at])
    if value < np.inf:
        score = value - TIE * float(moment.processes[at])
        reason = _said(moment, scores, at, veto=False)
        return Verdict(name, "chosen" if chosen else "fits", score, reason)
    if moment.closed[at]:
        return Verdict(name, "excluded", None, one_line(moment.closed[at]))
    full = _full_reason(moment, at)
    if full:
        return Verdict(name, "full", None, full)
    return Verdict(name, "vetoed", None, _said(moment, scores, at, veto=True))


def _said(moment: Moment, scores: Scores | None, at: int, *, veto: bool) -> str:
    """The policy's own reason; one that raises says nothing."""
    if scores is None or moment.policy is None:
        return ""
    hook, reason = ("veto_reason", scores.veto_reason) if veto else ("reason", scores.reason)
    try:
        return moment.plugins.ask("scoring", moment.policy[0], hook, lambda: str(reason(at)))
    except PluginError as error:
        return f"(no reason, because the policy failed: {error})"


def _full_reason(moment: Moment, at: int) -> str:
    """Which resource has too little room; "" if none."""
    limit = moment.cells[LIMIT, :, at] - moment.demand.headroom
    over = moment.cells[BUSY, :, at] + moment.need[:, at] - limit
    if not (over > CLOSE).any():
        return ""
    row = int(np.nanargmax(over))
    host, name = moment.table.hosts[moment.columns[at]], moment.resources[row]
    capacity = float(moment.cells[CAPACITY, row, at])
    used, reserved, need, most = (
        amount(float(part) * capacity, _unit_of(host, name))
        for part in (
            moment.cells[USAGE, row, at], moment.cells[LOAD, row, at], moment.need[row, at],
            limit[row],
        )
    )  # fmt: skip
    taken = f"{used} in use" + (f", {reserved} reserved" if moment.cells[LOAD, row, at] else "")
    return f"{name}: needs {need}; at most {most} ({limit[row]:.0%}) may be used: {taken}"


def _unit_of(host: Host, resource: str) -> str:
    units = (one.unit for one in host.description.resources if one.name == resource)
    return next(units, "")


# --- none may ever ----------------------------------------------------------------------------


def why_never(table: HostTable, demand: Demand) -> str:
    """Why no host may take this process before something other than room changes; "" if one may.

    A host that is lost, has left or is cordoned may not, as long as another one is there: what
    waits for it must not block those who do not. A host without a reading has reported no limits
    yet: that is not held against it.
    """
    if not len(table) or _possible(table, demand).any():
        return ""
    unmeasured = _unmeasured(table, demand)
    if unmeasured:
        return unmeasured
    return _host_by_host(table, lambda column: _never_reason(table, demand, column))


def a_known_host_may(table: HostTable, demand: Demand) -> bool:
    """Return True if a host whose limits are known may take a demand."""
    return bool((_possible(table, demand) & ~table.without_reading()).any())


def _possible(table: HostTable, demand: Demand) -> BoolArray:
    """(H,) True: may take a demand before something other than room changes."""
    possible = may_ever_take(table, demand)
    away = table.away()
    if not away.all():
        possible &= ~away
    for name in demand.excluded:
        host = table.by_name.get(name)
        if host is not None:
            possible[host.column] = False
    return possible


def why_all_away(table: HostTable) -> str:
    """Return why each host is away; "" if one of them is there."""
    away = table.away() | (table.condition == HostCondition.EXPECTED)
    if not away.all():
        return ""
    return f"every host is away: {_host_by_host(table, table.why_away)}"


def _host_by_host(table: HostTable, reason: Callable[[int], str]) -> str:
    """Return the reason against each host by its column, equal ones once; "" without hosts."""
    listed = table.listed()
    said = by_reason((host.name, reason(host.column)) for host in listed[:_NAMED_HOSTS])
    more = len(listed) - _NAMED_HOSTS
    return f"{said}; and {counted(more, 'more host')}" if more > 0 else said


def _unmeasured(table: HostTable, demand: Demand) -> str:
    """Return which resource no host reports, with the nearest one that is; "" if there is none."""
    for resource in sorted(demand.declared - set(table.resources)):
        near = get_close_matches(resource, table.resources, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        there = ", ".join(sorted(table.resources)) or "none"
        return f"no host reports the resource {resource!r}{hint} (reported: {there})"
    return ""


def refused_everywhere(table: HostTable, demand: Demand) -> bool:
    """Every host that might have taken the process has refused it."""
    if not demand.excluded:
        return False
    allowed = Demand(demand.spec, demand.amounts, demand.estimated)
    might = may_ever_take(table, allowed)
    return all(table.hosts[column].name in demand.excluded for column in np.flatnonzero(might))


def may_ever_take(table: HostTable, demand: Demand) -> BoolArray:
    """Return which hosts, (H,), fit a demand if nothing else runs there.

    A host that is expected back counts, since its capacity is not known yet; a pruned one does not.
    """
    need = table.fractions(demand.amounts, demand.estimated)
    too_large = ((need > table.limit + CLOSE) & (table.capacity > 0.0)).any(axis=0)
    is_listed = table.condition != HostCondition.LEFT  # of a host without a reading
    return np.where(table.without_reading(), is_listed, eligible(table, demand) & ~too_large)


def _never_reason(table: HostTable, demand: Demand, column: int) -> str:
    reason = _exclusion(table, demand, column) or table.why_away(column)
    if reason:
        return first_line(reason)  # `rosrm explain` has the details
    need = table.fractions_of(table.hosts[column], demand.amounts, demand.estimated)
    row = int(np.argmax(need - table.limit[:, column]))
    name, limit = table.resources[row], float(table.limit[row, column])
    unit, capacity = _unit_of(table.hosts[column], name), float(table.capacity[row, column])
    needed, has, most = (amount(part * capacity, unit) for part in (float(need[row]), 1.0, limit))
    return f"it has {has} of {name}, of which {most} ({limit:.0%}) may be used; needed: {needed}"
