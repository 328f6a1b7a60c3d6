"""Ranking of hosts for a process: filter, score, pick.

A host fits if it passes every filter of `filters.py` and no policy vetoes it. Of the hosts that
fit, the one with the lowest score is picked (with the policy `weighted`: Eq. 1 of the paper). The
score of a chain of policies is the sum of their scores, each times its weight.
A `Ranking` caches the scores for one demand. Equal processes share it, and after an assignment only
the scores of the changed hosts are computed again.

This module is the hot path of the master. New readings cost one pass over all hosts for each
demand, without the filters and needs that readings do not change; each assignment costs one refresh
and one argmin.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Final

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates, Columns, candidates
from rosrm.core.master.scheduling.filters import (
    BY_ASSIGNMENT,
    BY_READING,
    PLUGINS,
    STANDING,
    STEADY,
    Refusal,
    passing,
    refusals,
)
from rosrm.core.master.scheduling.host_views import checked_scores, host_view, process_view
from rosrm.core.master.scheduling.proximity import keeping_all, preference
from rosrm.core.master.scheduling.shortlist import MOST, Shortlist
from rosrm.core.master.scheduling.traffic import keeping_limits, rows_of
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.devices import COUNTED
from rosrm.core.master.state.host_arrays import TIE, BoolArray, FloatArray, IntArray
from rosrm.core.master.state.hosts import HostTable
from rosrm.errors import PluginError
from rosrm.extensions.declared_fields import FLOWS_FIELD
from rosrm.extensions.link_views import FlowView
from rosrm.extensions.placement import ScoringLink

#: Number of equal processes for which one call of the policy scores a host ahead.
_AT_A_TIME: Final = COUNTED

#: Largest size of one policy's score in the sum of a chain, so that the sum is finite.
_LARGEST_SCORE: Final = 1e300


class Ranking:
    """The score of every host for one demand, updated column by column.

    Attributes:
        need: (R, H) fractions of each host's capacity.
        value: (H,) score, term of preferred neighbours and tie-break; inf where the host does not
            fit now.
        judges: the policies in use; (): all were left out, and each fitting host scores 0.
        failure: why policies were left out.
        reads_tenants: True if a plugin has read which processes run on the hosts.
    """

    def __init__(self, table: HostTable, demand: Demand) -> None:
        self.table = table
        self.demand = demand
        self.need = table.fractions(demand.amounts, demand.estimated)
        self._every = slice(0, len(table))
        self._all: Candidates | None = None
        self._steady = passing(STEADY, self._candidates(self._every))
        self._steady_version = table.version_without_readings
        self._tier = _tiers(table, demand)
        self._preference: FloatArray | None = None
        self._flows: FlowView | None = None
        self._alone: Ranking | None = None
        self.value: FloatArray
        self._best_tier: Shortlist | None
        self._judge_all()

    def _judge_all(self) -> None:
        """Judge every host with the current readings."""
        table, plugins = self.table, self.demand.plugins
        self.judges, self._fallback = plugins.chain, plugins.fallback
        self.reads_tenants, self.failure = False, ""
        self.version, self._seen, self._own = table.version, len(table.touched), -1
        judged = self._candidates(self._every)
        self._standing = passing(BY_READING, judged, self._steady)
        self._refusals: dict[int, Refusal | None] = {}
        self._ahead: dict[int, list[float]] = {}
        self._judge(judged)

    def beside(self, demand: Demand) -> Ranking:
        """Return this ranking for a demand that differs by its neighbours and flows alone.

        These change with each assignment, so that few demands share a ranking with them. Only the
        policies and filters that read flows, which this ranking left out, are asked again.
        """
        found = copy(self)
        found._set_surroundings(demand, self)  # noqa: SLF001 - it is of this class
        return found

    def _set_surroundings(self, demand: Demand, alone: Ranking) -> None:
        self.demand, self._alone, self._all = demand, alone, None
        self._refusals, self._ahead = {}, {}
        self._preference = preference(self.table, demand)
        value = self.value + (0.0 if self._preference is None else self._preference)
        limits = keeping_limits(self.table.links, demand.traffic, len(self.table))
        for kept in (keeping_all(self.table, demand), limits):
            if kept is not None:
                self._standing = self._standing & kept
                value[~kept] = np.inf
        self._set_values(value)
        if demand.flows_are_read:
            self._judge_flows(alone)

    def _judge_flows(self, alone: Ranking) -> None:
        """Add the scores of the policies that read flows, and apply such filters."""
        chain = self.demand.plugins.chain
        readers = tuple(one for one in chain if FLOWS_FIELD in one.reads)
        self.judges = tuple(one for one in chain if one in alone.judges or one in readers)
        self._fallback = self.demand.plugins.fallback
        judged = self._candidates(self._every)
        self._flows = judged.flows()
        fits = passing([PLUGINS], judged, self.value < np.inf)
        value = self._scored(readers, judged, fits, np.where(fits, self.value, 0.0))
        if value is None:
            self._judge(judged)
        else:
            self._set_values(value)

    def note_assignment(self) -> None:
        """Note that the newest change of the table was an assignment of this demand."""
        self._own = len(self.table.touched)
        if self._alone is not None:
            self._alone.note_assignment()

    def outlasts_readings(self) -> bool:
        """Return True if only readings and assignments have changed the hosts since it was made.

        A ranking with neighbours or flows returns False, because few demands share it.
        """
        made = self._steady_version == self.table.version_without_readings
        return made and self._alone is None

    def refresh(self) -> None:
        """Update the columns that readings and assignments have changed since the last refresh."""
        if self.version != self.table.version:
            if self.demand.estimated:  # a part of the limits, which readings report
                self.need = self.table.fractions(self.demand.amounts, self.demand.estimated)
                self._all = None
            self._judge_all()
            return
        touched = self.table.touched[self._seen :]
        self._seen += len(touched)
        if len(touched) == 1 and self._own == self._seen and not self.reads_tenants:
            self._judge_ahead(touched[0])
            return
        columns = set(touched)
        for column in columns & self._ahead.keys():
            del self._ahead[column]
        if columns:
            self._judge_at(np.fromiter(columns, np.int64, len(columns)))

    def best(self) -> int:
        """Return the column with the lowest value; -1: none fits."""
        best = self._preferred().lowest(1)
        return best[0] if best else -1

    def lowest(self) -> list[int]:
        """Return the few fitting columns with the lowest values, best first."""
        return self._preferred().lowest()

    def fitting(self) -> int:
        """Return the number of hosts that may take the process now."""
        return self._shortlist.finite()

    def in_order(self) -> list[int]:
        """Return all fitting columns, best first: by the tier of labels, then by value."""
        fitting = np.flatnonzero(self.value < np.inf)
        tiers = () if self._tier is None else (self._tier[fitting],)
        order = np.lexsort((self.value[fitting], *tiers))  # the last key comes first
        return [int(column) for column in fitting[order]]

    def fits(self, column: int) -> bool:
        """Return True if this host may take the process now."""
        return bool(self.value[column] < np.inf)

    def standing_refusals(self, columns: Sequence[int]) -> tuple[Refusal | None, ...]:
        """Return for each host the first failed filter that assignments do not change."""
        new = [
            column for column in columns
            if not self._standing[column] and column not in self._refusals
        ]  # fmt: skip
        if new:
            hosts = self._candidates(np.array(new))
            self._refusals.update(zip(new, refusals(STANDING, hosts), strict=True))
        return tuple(self._refusals.get(column) for column in columns)

    def _judge_at(self, columns: Columns) -> None:
        """Set `value` of some columns."""
        self._judge(self._candidates(columns))

    def _judge(self, judged: Candidates) -> None:
        """Set `value` of some hosts."""
        value = self._value(judged)
        if value is None:
            self._judge_at(self._every)  # scores of two policies are not comparable
        elif isinstance(judged.columns, slice):
            self._set_values(value)
        elif len(value) > MOST:
            self.value[judged.columns] = value
            self._set_values(self.value)
        else:
            self._put(judged.columns.tolist(), value.tolist())

    def _set_values(self, value: FloatArray) -> None:
        """Set `value` of all hosts."""
        self.value, self._shortlist, self._best_tier = value, Shortlist(value), None

    def _put(self, columns: list[int], values: list[float]) -> None:
        self._shortlist.put(columns, values)
        if self._tier is not None:
            self._best_tier = None

    def _judge_ahead(self, column: int) -> None:
        """Set `value` of a column that just took a process of this demand.

        Thousands of equal processes may be waiting. So one call of the policy scores the host with
        0, 1, 2, … more of them, as if each were a host of its own.
        """
        values = self._ahead.get(column)
        if not values:
            more = np.arange(_AT_A_TIME)
            ahead = self._value(self._candidates(np.full(_AT_A_TIME, column), more))
            if ahead is None:
                self._judge_at(self._every)
                return
            if self.reads_tenants:  # which shows none of the processes that are added
                self._judge_at(np.array([column]))
                return
            values = self._ahead[column] = ahead[::-1].tolist()
        self._put([column], [values.pop()])

    def _candidates(self, columns: Columns, more: IntArray | None = None) -> Candidates:
        """Return some hosts with the demand; `more` as in `candidates`.

        The candidates of all hosts are kept, because their arrays are views of the table.
        """
        if columns is not self._every:
            return candidates(self.table, self.demand, self.need, columns, more)
        if self._all is None or self.demand.spec.devices:  # their counts are not in it
            self._all = candidates(self.table, self.demand, self.need, columns)
        return self._all

    def _value(self, judged: Candidates) -> FloatArray | None:
        """Return the values of hosts; None: the policy was left out, so all values are void."""
        columns = judged.columns
        judged.known_flows = self.flows(columns)
        fits = passing(BY_ASSIGNMENT, judged, self._standing[columns])
        value = self.table.ties[columns].copy()
        if judged.more is not None:
            value = np.multiply(judged.processes, TIE, dtype=np.float64)
        if self._preference is not None:
            value += self._preference[columns]
        return self._scored(self.judges, judged, fits, value)

    def _scored(
        self, judges: Sequence[ScoringLink], judged: Candidates, fits: BoolArray, value: FloatArray
    ) -> FloatArray | None:
        """Add the scores of policies to `value`; None: a policy was left out, so all are void."""
        for link in judges if np.count_nonzero(fits) else ():
            try:
                score, veto = _answer(link, judged, fits)
            except PluginError as error:
                self._leave_out(link, error)
                return None
            value += score
            if veto is not None:
                fits = fits & ~veto
        self.reads_tenants = self.reads_tenants or judged.tenants_read
        value[~fits] = np.inf
        return value

    def flows(self, columns: Columns) -> FlowView | None:
        """Return the flows of the process on some hosts; None: no plugin has read them."""
        return self._flows and rows_of(self._flows, columns)

    def _leave_out(self, link: ScoringLink, error: PluginError) -> None:
        """Leave out a policy that raised or broke its contract.

        The other policies of the chain decide; after the last of them the fallback; then none.
        """
        self.judges = tuple(one for one in self.judges if one is not link)
        if not self.judges and self._fallback is not None:
            self.judges, self._fallback = (self._fallback,), None
        reason = f"left out: {link.name!r}, {error}"
        self.failure = f"{self.failure}; {reason}" if self.failure else reason
        self._ahead.clear()

    def _preferred(self) -> Shortlist:
        """Return the shortlist of all hosts, or of those in the best tier of labels that fits."""
        if self._best_tier is None:
            self._best_tier, tier = self._shortlist, self._tier
            if tier is not None and (fitting := self.value < np.inf).any():
                value = np.where(tier == tier[fitting].min(), self.value, np.inf)
                self._best_tier = Shortlist(value)
        return self._best_tier


def _answer(
    link: ScoringLink, hosts: Candidates, fits: BoolArray
) -> tuple[FloatArray, BoolArray | None]:
    """Return the weighted scores and the vetoes of a policy; raise PluginError if it fails."""
    views = host_view(hosts), process_view(hosts, link.reads)
    score, veto = hosts.demand.plugins.calls.ask(
        "scoring", link.name, "score",
        lambda: checked_scores(link.policy.score(*views), views[0], fits), link.policy,
    )  # fmt: skip
    if len(hosts.demand.plugins.chain) > 1 or link.weight != 1.0:
        score = link.weight * np.clip(np.nan_to_num(score), -_LARGEST_SCORE, _LARGEST_SCORE)
    return score, veto


def _tiers(table: HostTable, demand: Demand) -> IntArray | None:
    """Return the tier of each host, (H,), of which the lowest is picked; None: all are equal.

    An avoided label raises the tier; a preferred label or host lowers it.
    """
    spec = demand.spec
    if not spec.preferred_labels and not spec.avoided_labels and not demand.near:
        return None
    many = len(spec.preferred_labels) + 2
    tiers = np.zeros(len(table), np.int64)
    for key, value in spec.avoided_labels.items():
        tiers += many * table.labelled(key, value)
    for key, value in spec.preferred_labels.items():
        tiers -= table.labelled(key, value)
    for name in demand.near:
        host = table.by_name.get(name)
        if host is not None:
            tiers[host.column] -= 1
    return tiers
