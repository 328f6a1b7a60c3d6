"""Placement decisions: the outcome of a ranking, with the reasons for and against hosts.

Most decisions are never read. So a decision copies the values of the few hosts that it names, and
formats its verdicts only when they are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates, candidates
from rosrm.core.master.scheduling.filters import (
    BY_ASSIGNMENT,
    OF_ROOM,
    Refusal,
    first_of,
    refusals,
)
from rosrm.core.master.scheduling.host_views import checked_scores, host_view, process_view
from rosrm.core.master.scheduling.proximity import unmet
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.host_arrays import TIE
from rosrm.errors import PluginError
from rosrm.extensions.contracts import Scores
from rosrm.extensions.placement import ScoringLink
from rosrm.extensions.plugin_calls import PluginCalls, required
from rosrm.model.lazy import Lazy
from rosrm.model.values import EMPTY
from rosrm.wording import first_line

#: Largest number of hosts that an explanation names all; of more, it names the best fitting ones.
_NAMED_HOSTS: Final = 16
#: Reason against a host if a plugin has failed, or gives another answer, since the decision.
_NO_REASON: Final = "a plugin refused it that gives no reason now; see `rosrm plugins`"
#: Reason against a host that fails a filter of `OF_ROOM`, where a text must not change at once.
NO_ROOM: Final = "it has no room"
#: Kind of a decision; "": not set yet; "fits": a host could take a process that waits.
DecisionKind = Literal["", "assigned", "set_aside", "waits", "fits", "migrated"]


class Verdict(NamedTuple):
    """The verdict on one host.

    Attributes:
        score: None where the host does not fit.
    """

    host: str
    verdict: Literal["chosen", "fits", "full", "vetoed", "excluded"]
    score: float | None
    reason: str

    def to_json(self) -> dict[str, Any]:
        """Return the verdict as the event record has it."""
        return {
            "name": self.host, "verdict": self.verdict, "score": self.score, "reason": self.reason,
        }  # fmt: skip


class Part(NamedTuple):
    """Scores and reasons of one policy in a decision.

    Attributes:
        values: the checked scores of the hosts by row; None: the policy failed.
        reasons: row to the policy's reason for the score of the host, or for the veto on it.
    """

    link: ScoringLink
    values: Sequence[float] | None
    reasons: Mapping[int, str]


@dataclass(slots=True)  # not frozen, because each of thousands would take 1 µs more to create
class Moment:
    """Copies of the values of n hosts at the time of a decision.

    Attributes:
        judges: the scoring policies that decided.
        failure: why policies were left out; "": none was.
        hosts: with copies of all that assignments change.
        value: score plus tie-break of each host; inf where the host did not fit.
        standing: for each host the first failed filter that assignments do not change.
    """

    judges: tuple[ScoringLink, ...]
    failure: str
    hosts: Candidates
    value: list[float]
    standing: tuple[Refusal | None, ...]

    def parts(self, refused: Sequence[Refusal | None]) -> list[Part]:
        """Compute the scores of each policy again (a policy is pure), with its reasons.

        Args:
            refused: for each host the filter that refuses it, or None. A veto on a host that a
                filter refuses needs no reason.
        """
        if not len(self.hosts):
            return []
        scored = [at for at, value in enumerate(self.value) if value < inf]
        others = [at for at, value in enumerate(self.value) if value == inf and refused[at] is None]
        return [self._part(link, scored, others) for link in self.judges]

    def _part(self, link: ScoringLink, scored: Sequence[int], others: Sequence[int]) -> Part:
        """Return scores and reasons of a policy; one call with one time-out covers both."""
        views = host_view(self.hosts), process_view(self.hosts, link.reads)
        fits = np.isin(np.arange(len(self.hosts)), scored)

        def scores_and_reasons() -> Part:
            scores = link.policy.score(*views)
            values, veto = checked_scores(scores, views[0], fits)
            vetoed = [at for at in others if veto is not None and veto[at]]
            reasons = self._reasons(link, scores, "reason", scored)
            reasons |= self._reasons(link, scores, "veto_reason", vetoed)
            return Part(link, values.tolist(), reasons)

        try:
            return self.plugins.ask("scoring", link.name, "score", scores_and_reasons, link.policy)
        except PluginError as error:  # the decision itself does not need the reasons
            return Part(link, None, _failure_notes(scored, error))

    def _reasons(
        self, link: ScoringLink, scores: Scores, hook: str, rows: Sequence[int]
    ) -> dict[int, str]:
        """Ask a policy for its reasons in one guarded call; return a note if that call fails."""
        ask = getattr(scores, hook)

        def reasons() -> dict[int, str]:
            return {at: required(ask(at), str) for at in rows}

        try:
            return self.plugins.ask("scoring", link.name, hook, reasons, scores) if rows else {}
        except PluginError as error:
            return _failure_notes(rows, error)

    @property
    def policy(self) -> str:
        """Return the names of the policies that decided, and those left out, with reasons."""
        name = " + ".join(map(str, self.judges))
        if not self.failure:
            return name
        return f"{name} ({self.failure})" if name else self.failure

    @property
    def plugins(self) -> PluginCalls:
        """Return the guard of the calls of plugins."""
        return self.hosts.demand.plugins.calls

    def refusals(self) -> list[Refusal | None]:
        """Return for each host the first filter that it failed; a host that fits failed none."""
        if inf not in self.value:
            return [None] * len(self.value)
        changing = refusals(BY_ASSIGNMENT, self.hosts)
        return [first_of(*both) for both in zip(self.standing, changing, strict=True)]


class Decision(Lazy):
    """The outcome for one process; as a mapping, it has the form of the event record.

    Attributes:
        column: column of the chosen host; -1: none fits now.
        omitted: verdict to the number of hosts with that verdict that are not named.
    """

    __slots__ = ("_moment", "column", "kind", "omitted")

    def __init__(self, column: int, moment: Moment, omitted: Mapping[str, int]) -> None:
        super().__init__()
        self.kind: DecisionKind = ""
        self.column = column
        self.omitted = omitted
        self._moment = moment

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Return the verdicts on up to 16 hosts; the chosen one first."""
        return _verdicts(self._moment, chosen=self.column >= 0)

    def render(self) -> Mapping[str, Any]:
        """Return the decision as the event record has it."""
        verdicts = self.verdicts
        return {
            "kind": self.kind,
            "policy": self._moment.policy,
            "chosen": verdicts[0].host if self.column >= 0 else None,
            "need": dict(self._moment.hosts.demand.amounts),
            "hosts": [verdict.to_json() for verdict in verdicts],
            "omitted": dict(self.omitted),
        }


def decide(ranking: Ranking, *, chosen: int | None = None) -> Decision:
    """Return the outcome of a ranking with its reasons.

    Args:
        ranking: up to date.
        chosen: column that the caller has chosen, -1: none; None: choose the best.
    """
    column = ranking.best() if chosen is None else chosen
    listed = ranking.table.listed()
    if len(listed) <= _NAMED_HOSTS:
        moment = _moment(ranking, _first(column, [host.column for host in listed]))
        return Decision(column, moment, EMPTY)
    # With many hosts, only the runners-up are named, because this path must be quick.
    first = [host.column for host in listed[:_NAMED_HOSTS]] if column < 0 else ranking.lowest()
    moment = _moment(ranking, _first(column, first))
    named, fitting = len(moment.value), ranking.fitting()
    named_fitting = named - moment.value.count(inf)
    omitted = {
        "would take it at a higher score": fitting - named_fitting,
        "cannot take it now": len(listed) - fitting - (named - named_fitting),
    }
    return Decision(column, moment, omitted)


def _first(column: int, columns: Sequence[int]) -> list[int]:
    """Return the columns, the chosen one first; if it is not among them, it replaces the last."""
    if column < 0 or columns[:1] == [column]:
        return list(columns)
    others = [other for other in columns if other != column]
    return [column, *(others[:-1] if len(others) == len(columns) else others)]


def verdict_of(ranking: Ranking, column: int) -> Verdict:
    """Return the verdict on one host."""
    return _verdicts(_moment(ranking, [column]), chosen=False)[0]


def why_each_refuses(ranking: Ranking, columns: Sequence[int]) -> list[tuple[str, str]]:
    """Return the name of each of these hosts, none of which fits, and the reason in one line.

    The reason of a full host is `NO_ROOM`, without its changing numbers.
    """
    moment = _moment(ranking, list(columns))
    refused = moment.refusals()
    parts = moment.parts(refused) if None in refused else ()
    return [
        (
            moment.hosts.host(at).name,
            NO_ROOM
            if refusal is not None and refusal.filter.name in OF_ROOM
            else first_line(_verdict(moment, parts, refusal, at, chosen=False).reason),
        )
        for at, refusal in enumerate(refused)
    ]


def _moment(ranking: Ranking, columns: list[int]) -> Moment:
    at = np.array(columns, np.int64)
    hosts = candidates(ranking.table, ranking.demand, ranking.need, at)
    hosts.known_flows = ranking.flows(at)
    value: list[float] = ranking.value[at].tolist()
    standing = ranking.standing_refusals(columns) if inf in value else (None,) * len(columns)
    if ranking.reads_tenants:
        hosts.keep_tenants()
    return Moment(ranking.judges, ranking.failure, hosts, value, standing)


def _verdicts(moment: Moment, *, chosen: bool) -> tuple[Verdict, ...]:
    """Return the verdicts on the hosts of a moment; `chosen`: the first host was chosen."""
    refused = moment.refusals()
    parts = moment.parts(refused)
    return tuple(
        _verdict(moment, parts, refused[at], at, chosen=chosen and at == 0)
        for at in range(len(moment.hosts))
    )


def _verdict(
    moment: Moment, parts: Sequence[Part], refused: Refusal | None, at: int, *, chosen: bool
) -> Verdict:
    name, value = moment.hosts.host(at).name, moment.value[at]
    if value < inf:
        score = value - TIE * float(moment.hosts.processes[at])
        reason = "; ".join(filter(None, (_sum(parts, at), unmet(moment.hosts, at))))
        return Verdict(name, "chosen" if chosen else "fits", score, reason)
    if refused is not None:
        return Verdict(name, refused.filter.verdict, None, refused.reason)
    return Verdict(name, "vetoed", None, _vetoes(parts, at) or _NO_REASON)


def _sum(parts: Sequence[Part], at: int) -> str:
    """Return the reasons for the score of a host; of a chain with the score of each policy."""
    if len(parts) == 1 and parts[0].link.weight == 1.0:
        return parts[0].reasons.get(at, "")
    return " + ".join(
        f"{part.link} {part.values[at]:.3f} ({part.reasons[at]})"
        for part in parts
        if part.values is not None
    )


def _vetoes(parts: Sequence[Part], at: int) -> str:
    """Return the reason of each veto on a host; of a chain with the name of the policy."""
    vetoes = [part for part in parts if at in part.reasons]
    if len(parts) == 1:
        return "".join(part.reasons[at] for part in vetoes)
    return "; ".join(f"{part.link.name}: {part.reasons[at]}" for part in vetoes)


def _failure_notes(rows: Sequence[int], error: PluginError) -> dict[int, str]:
    """Return for each row a note in place of the reason, because the policy has failed."""
    return dict.fromkeys(rows, f"(no reason, because the policy failed: {error})")
