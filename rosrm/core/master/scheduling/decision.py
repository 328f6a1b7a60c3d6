"""Placement decisions: the outcome of a ranking, with the reasons for and against hosts.

Most decisions are never read. So a decision copies the values of the few hosts that it names, and
formats its verdicts only when they are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates, candidates
from rosrm.core.master.scheduling.filters import BY_ASSIGNMENT, Refusal, first_of, refusals
from rosrm.core.master.scheduling.host_views import host_view, process_view
from rosrm.core.master.scheduling.proximity import unmet
from rosrm.core.master.scheduling.ranking import TIE, NamedPolicy, Ranking
from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.core.master.state.lazy import Lazy
from rosrm.errors import PluginError
from rosrm.extensions.contracts import Scores
from rosrm.extensions.plugin_calls import PluginCalls, required
from rosrm.model.values import EMPTY

#: Largest number of hosts that an explanation names all; of more, it names the best fitting ones.
_NAMED_HOSTS: Final = 16
#: Kind of a decision; "": not set yet.
DecisionKind = Literal["", "assigned", "set_aside", "waits", "migrated"]


@dataclass(frozen=True, slots=True)
class Verdict:
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


@dataclass(slots=True)  # not frozen, because that costs 1 µs for each of thousands
class Moment:
    """Copies of the values of n hosts at the time of a decision.

    Attributes:
        plugins: guards the calls of the policy.
        hosts: with copies of the arrays that assignments change.
        value: (n,) score plus tie-break; inf where the host did not fit.
        standing: for each host the first failed filter that assignments do not change.
    """

    policy: NamedPolicy | None
    plugins: PluginCalls
    hosts: Candidates
    value: FloatArray
    standing: tuple[Refusal | None, ...]

    def scores(self) -> Scores | None:
        """Return the policy's scores again, for their reasons (a policy is pure); None: none."""
        if self.policy is None or not len(self.hosts):
            return None
        name, policy = self.policy
        hosts, process = host_view(self.hosts), process_view(self.hosts)
        try:
            return self.plugins.ask(
                "scoring", name, "score", lambda: required(policy.score(hosts, process), Scores)
            )
        except PluginError:
            return None  # the decision itself does not need the reasons

    def refusals(self) -> list[Refusal | None]:
        """Return for each host the first filter that it failed."""
        changing = refusals(BY_ASSIGNMENT, self.hosts)
        return [first_of(*both) for both in zip(self.standing, changing, strict=True)]


class Decision(Lazy):
    """The outcome for one process; as a mapping, it has the form of the event record.

    Attributes:
        column: column of the chosen host; -1: none fits now.
        policy: name of the policy that decided, and the policies left out, with reasons.
        omitted: verdict to the number of hosts with that verdict that are not named.
    """

    __slots__ = ("_moment", "column", "kind", "omitted", "policy")

    def __init__(
        self, column: int, policy: str, moment: Moment, omitted: Mapping[str, int]
    ) -> None:
        super().__init__()
        self.kind: DecisionKind = ""
        self.column = column
        self.policy = policy
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
            "policy": self.policy,
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
    first = [host.column for host in listed[:_NAMED_HOSTS]]
    if len(listed) <= _NAMED_HOSTS:
        moment = _moment(ranking, _first(column, first))
        return Decision(column, ranking.policy_name, moment, EMPTY)
    # With many hosts, only the runners-up are named, because this path must be quick.
    nearly = ranking.lowest() if column >= 0 else first
    moment = _moment(ranking, _first(column, nearly))
    named, fitting = len(moment.value), int(np.count_nonzero(ranking.value < np.inf))
    named_fitting = sum(value < np.inf for value in moment.value.tolist())
    omitted = {
        "would take it at a higher score": fitting - named_fitting,
        "cannot take it now": len(listed) - fitting - (named - named_fitting),
    }
    return Decision(column, ranking.policy_name, moment, omitted)


def _first(column: int, columns: Sequence[int]) -> list[int]:
    """Return the columns, the chosen one first; if it is not among them, it replaces the last."""
    if column < 0:
        return list(columns)
    others = [other for other in columns if other != column]
    return [column, *(others[:-1] if len(others) == len(columns) else others)]


def verdict_of(ranking: Ranking, column: int) -> Verdict:
    """Return the verdict on one host."""
    return _verdicts(_moment(ranking, [column]), chosen=False)[0]


def _moment(ranking: Ranking, columns: list[int]) -> Moment:
    at = np.array(columns, np.int64)
    hosts = candidates(ranking.table, ranking.demand, ranking.need, at)
    value = ranking.value[at]
    some_fail = np.inf in value.tolist()
    standing = ranking.standing_refusals(columns) if some_fail else (None,) * len(columns)
    return Moment(ranking.judge, ranking.plugins, hosts, value, standing)


def _verdicts(moment: Moment, *, chosen: bool) -> tuple[Verdict, ...]:
    """Return the verdicts on the hosts of a moment; `chosen`: the first host was chosen."""
    scores, refused = moment.scores(), moment.refusals()
    return tuple(
        _verdict(moment, scores, refused[at], at, chosen=chosen and at == 0)
        for at in range(len(moment.hosts))
    )


def _verdict(
    moment: Moment, scores: Scores | None, refused: Refusal | None, at: int, *, chosen: bool
) -> Verdict:
    name, value = moment.hosts.host(at).name, float(moment.value[at])
    if value < np.inf:
        score = value - TIE * float(moment.hosts.processes[at])
        reason = _policy_reason(moment, scores, at, veto=False)
        reason = "; ".join(filter(None, (reason, unmet(moment.hosts, at))))
        return Verdict(name, "chosen" if chosen else "fits", score, reason)
    if refused is not None:
        return Verdict(name, refused.filter.verdict, None, refused.reason)
    return Verdict(name, "vetoed", None, _policy_reason(moment, scores, at, veto=True))


def _policy_reason(moment: Moment, scores: Scores | None, at: int, *, veto: bool) -> str:
    """Return the policy's own reason, or a note that the policy failed."""
    if scores is None or moment.policy is None:
        return ""
    hook, reason = ("veto_reason", scores.veto_reason) if veto else ("reason", scores.reason)
    try:
        return moment.plugins.ask("scoring", moment.policy[0], hook, lambda: str(reason(at)))
    except PluginError as error:
        return f"(no reason, because the policy failed: {error})"
