"""Which host takes a process: filter, score, pick; and why that one and not the others.

A host fits when reading + in-flight load + need stays under every limit. Among the hosts that fit
the lowest score goes first (Eq. 1 of the paper with the policy `weighted`). A `Ranking` keeps the
scores of one demand, so that a queue of equal processes is judged once and then only where an
assignment has changed a host.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rosrm.core.hosts import BoolArray, FloatArray, HostTable
from rosrm.core.model import ProcessSpec
from rosrm.ports import HostView, ProcessView, Scores, ScoringPolicy

#: Equal scores: the host with fewer processes goes first, then the one registered first.
_TIE: Final = 1e-9
#: An explanation names every host up to this many, else the best of those that fit.
_NAMED_HOSTS: Final = 16
_CLOSE: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Demand:
    """What decides where a process may go; equal demands share a ranking.

    Attributes:
        needs: (resource, amount in base units), sorted.
        excluded: (host name, why) where it must not go, sorted.
        headroom: fraction by which a host must stay under each limit.
    """

    spec: ProcessSpec
    needs: tuple[tuple[str, float], ...]
    excluded: tuple[tuple[str, str], ...] = ()
    headroom: float = 0.0

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for processes that every host judges alike."""
        spec = self.spec
        return (
            spec.program, self.needs, self.excluded, self.headroom,
            tuple(sorted(spec.required_labels.items())),
            tuple(sorted(spec.preferred_labels.items())),
            tuple(sorted(spec.avoided_labels.items())),
        )  # fmt: skip


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


@dataclass(frozen=True, slots=True)
class Decision:
    """The outcome for one process.

    Attributes:
        column: of the chosen host; -1: none fits now.
        needs: base units by resource.
        verdicts: of up to 16 hosts; the chosen one first.
        omitted: how many hosts had which verdict beside those.
    """

    column: int
    policy: str
    needs: Mapping[str, float]
    verdicts: tuple[Verdict, ...]
    omitted: Mapping[str, int] = field(default_factory=dict)

    def to_json(self, kind: str) -> dict[str, Any]:
        """As it stands in the event record."""
        chosen = self.verdicts[0].host if self.column >= 0 else None
        return {
            "kind": kind, "policy": self.policy, "chosen": chosen, "need": dict(self.needs),
            "hosts": [verdict.to_json() for verdict in self.verdicts],
            "omitted": dict(self.omitted),
        }  # fmt: skip


class Ranking:
    """The judgement of every host for one demand, kept up to date column by column.

    Attributes:
        need: (R, H) fractions of each host's capacity.
        value: (H,) score plus tie-break; inf where the host does not fit now.
        failure: why the policy was left out; then every host that fits scores 0.
    """

    def __init__(self, table: HostTable, policy: ScoringPolicy, demand: Demand) -> None:
        self._table = table
        self._policy = policy
        self.demand = demand
        self.failure = ""
        self.version = table.version
        self._seen = len(table.touched)
        self.need = table.fractions(dict(demand.needs))
        self.eligible = eligible(table, demand)
        self._tier = _tiers(table, demand.spec)
        self.value = self._judge(slice(0, len(table)))

    def refresh(self) -> None:
        """Judge anew the columns that assignments have changed since."""
        touched = self._table.touched
        for column in set(touched[self._seen :]):
            self.value[column] = self._judge(slice(column, column + 1))[0]
        self._seen = len(touched)

    def best(self) -> int:
        """The column with the lowest value; -1: none fits."""
        if not len(self.value):
            return -1
        column = int(np.argmin(self._preferred()))
        return column if bool(np.isfinite(self.value[column])) else -1

    def scores(self, columns: slice) -> Scores:
        """The policy's judgement; one that raises or answers nonsense is left out, and named."""
        if not self.failure:
            try:
                return self._ask_policy(columns)
            except Exception as error:  # noqa: BLE001 - a third party's code: anything may come
                self.failure = f"{type(error).__name__}: {error}"
        return Scores(np.zeros(columns.stop - columns.start))

    def _ask_policy(self, columns: slice) -> Scores:
        table = self._table
        hosts = HostView(
            names=[host.name for host in table.hosts[columns]] if columns.stop - columns.start < 64
            else _Names(table, columns),
            resources=table.resources,
            usage=(table.usage[:, columns] + table.load[:, columns]).T,
            limit=table.limit[:, columns].T,
            capacity=table.capacity[:, columns].T,
            processes=table.processes[columns],
        )  # fmt: skip
        scores = self._policy.score(hosts, ProcessView(self.demand.spec, self.need[:, columns].T))
        size = columns.stop - columns.start
        if np.shape(scores.value) != (size,):
            raise ValueError(f"scores of shape {np.shape(scores.value)} for {size} hosts")
        if np.isnan(scores.value).any():
            raise ValueError(f"the score of host {hosts.names[int(np.isnan(scores.value).argmax())]} is NaN")
        return scores

    def room(self, columns: slice) -> BoolArray:
        """(n,) True where reading + in-flight load + need stays under every limit."""
        table = self._table
        total = table.usage[:, columns] + table.load[:, columns]
        total += self.need[:, columns]
        allowed = table.limit[:, columns] - self.demand.headroom + _CLOSE
        return np.asarray((total <= allowed).all(axis=0))

    def _judge(self, columns: slice) -> FloatArray:
        table = self._table
        if columns.stop - columns.start == 1:
            open_now = self.eligible[columns] & table.takes(columns.start)
        else:
            open_now = self.eligible[columns] & table.taking()[columns]
        fits = open_now & self.room(columns)
        if not fits.any():
            return np.full(columns.stop - columns.start, np.inf)
        scores = self.scores(columns)
        if scores.veto is not None:
            fits = fits & ~scores.veto
        value = scores.value + _TIE * table.processes[columns]
        return np.asarray(np.where(fits, value, np.inf))

    def _preferred(self) -> FloatArray:
        """The values, only those of the best tier of labels that any fitting host is in."""
        if self._tier is None:
            return self.value
        fitting = np.isfinite(self.value)
        if not fitting.any():
            return self.value
        best = self._tier[fitting].min()
        return np.where(self._tier == best, self.value, np.inf)


class _Names(Sequence[str]):
    """Host names on demand: a thousand of them are not listed for each decision."""

    def __init__(self, table: HostTable, columns: slice) -> None:
        self._hosts = table.hosts
        self._start, self._length = columns.start, columns.stop - columns.start

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, row: Any) -> Any:
        return self._hosts[self._start + row].name


def eligible(table: HostTable, demand: Demand) -> BoolArray:
    """(H,) True: labels and exclusions allow the host."""
    allowed = np.ones(len(table), np.bool_)
    excluded = {name for name, _ in demand.excluded}
    if not excluded and not demand.spec.required_labels:
        return allowed
    for host in table.hosts:
        labels = host.description.labels
        allowed[host.column] = host.name not in excluded and all(
            labels.get(key) == value for key, value in demand.spec.required_labels.items()
        )
    return allowed


def why_never(table: HostTable, demand: Demand) -> str:
    """Why no known host may ever take this process; "" if one may, or none is known yet."""
    if not len(table):
        return ""
    need = table.fractions(dict(demand.needs))
    possible = eligible(table, demand)
    # A host that is expected back has told no capacity yet: it is not held against it.
    untold = (table.capacity <= 0.0).all(axis=0)
    large = (need > table.limit + _CLOSE).any(axis=0) & ~untold
    if (possible & ~large).any():
        return ""
    return "; ".join(
        f"{host.name}: {_never_reason(table, demand, host.column, need)}"
        for host in table.hosts[:_NAMED_HOSTS]
    )


def _never_reason(table: HostTable, demand: Demand, column: int, need: FloatArray) -> str:
    host = table.hosts[column]
    reason = _exclusion(demand, host.name, host.description.labels)
    if reason:
        return reason
    row = int(np.argmax(need[:, column] > table.limit[:, column] + _CLOSE))
    name = table.resources[row]
    if table.capacity[row, column] <= 0:
        return f"it has no {name}"
    return f"it needs {need[row, column]:.0%} of its {name}, over the limit of {table.limit[row, column]:.0%}"


def _exclusion(demand: Demand, name: str, labels: Mapping[str, str]) -> str:
    reason = dict(demand.excluded).get(name)
    if reason is not None:
        return reason
    missing = {k: v for k, v in demand.spec.required_labels.items() if labels.get(k) != v}
    if missing:
        return "it lacks the label " + ", ".join(f"{key}={value}" for key, value in missing.items())
    return ""


def _tiers(table: HostTable, spec: ProcessSpec) -> npt.NDArray[np.int64] | None:
    """(H,) lower goes first: avoided labels count up, preferred ones down; None: no such labels."""
    if not spec.preferred_labels and not spec.avoided_labels:
        return None
    many = len(spec.preferred_labels) + 1
    tiers = np.zeros(len(table), np.int64)
    for host in table.hosts:
        labels = host.description.labels
        avoided = sum(labels.get(key) == value for key, value in spec.avoided_labels.items())
        preferred = sum(labels.get(key) == value for key, value in spec.preferred_labels.items())
        tiers[host.column] = avoided * many - preferred
    return tiers


def decide(ranking: Ranking, policy: str, *, chosen: int | None = None) -> Decision:
    """The outcome of a ranking with its reasons.

    Args:
        ranking: refreshed.
        policy: name of the scoring policy.
        chosen: column decided elsewhere; None: the best.
    """
    column = ranking.best() if chosen is None else chosen
    table = ranking._table  # noqa: SLF001 - the two are one thing, split for reading
    columns = _named(ranking, column)
    verdicts = tuple(_verdict(ranking, at, column) for at in columns)
    omitted = {}
    if len(columns) < len(table):
        fitting = int(np.isfinite(ranking.value).sum())
        named = sum(v.verdict in ("fits", "chosen") for v in verdicts)
        omitted = {
            "fits with a higher score": fitting - named,
            "does not fit now": len(table) - fitting - (len(verdicts) - named),
        }
    return Decision(column, policy, dict(ranking.demand.needs), verdicts, omitted)


def _named(ranking: Ranking, column: int) -> list[int]:
    hosts = len(ranking.value)
    if hosts <= _NAMED_HOSTS:
        named = list(range(hosts))
    elif column >= 0:
        # Of many hosts only those that were nearly chosen are of interest, and time is short.
        named = [int(at) for at in np.argpartition(ranking.value, 3)[:3]]
    else:
        named = list(range(_NAMED_HOSTS))
    others: list[int] = [at for at in named if at != column]
    return ([column] if column >= 0 else []) + others


def _verdict(ranking: Ranking, column: int, chosen: int) -> Verdict:
    table = ranking._table  # noqa: SLF001 - the two are one thing, split for reading
    host = table.hosts[column]
    value = float(ranking.value[column])
    if column == chosen or np.isfinite(value):
        score = value - _TIE * float(table.processes[column])
        verdict = "chosen" if column == chosen else "fits"
        return Verdict(host.name, verdict, score if np.isfinite(score) else None, "")
    exclusion = _exclusion(ranking.demand, host.name, host.description.labels)
    if exclusion:
        return Verdict(host.name, "excluded", None, exclusion)
    closed = table.why_closed(column)
    if closed:
        return Verdict(host.name, "excluded", None, closed)
    at = slice(column, column + 1)
    if not ranking.room(at)[0]:
        return Verdict(host.name, "full", None, _full_reason(ranking, column))
    return Verdict(host.name, "vetoed", None, ranking.scores(at).veto_reason(0))


def _full_reason(ranking: Ranking, column: int) -> str:
    table = ranking._table  # noqa: SLF001 - the two are one thing, split for reading
    need = ranking.need[:, column]
    allowed = table.limit[:, column] - ranking.demand.headroom
    total = table.usage[:, column] + table.load[:, column] + need
    row = int(np.argmax(total - allowed))
    if table.capacity[row, column] <= 0:
        return f"it has no {table.resources[row]}"
    return (
        f"{table.resources[row]}: reading {table.usage[row, column]:.1%} + in flight "
        f"{table.load[row, column]:.1%} + need {need[row]:.1%} > {allowed[row]:.1%}"
    )
