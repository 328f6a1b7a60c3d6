"""Which host takes a process: filter, score, pick.

A host fits when reading + in-flight load + need stays under every limit. Among the hosts that fit
the lowest score goes first (Eq. 1 of the paper with the policy `weighted`). A `Ranking` keeps the
scores of one demand, so that a queue of equal processes is judged once and then only where an
assignment has changed a host.

This module is the hot path of the master: a ranking is made once for each demand and batch of
readings (one pass over all hosts), and one refresh and one argmin follow for each assignment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.host_arrays import (
    BUSY,
    CAPACITY,
    LIMIT,
    BoolArray,
    FloatArray,
    IntArray,
)
from rosrm.core.master.state.hosts import Host, HostTable
from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostView, ProcessView, Scores, ScoringPolicy
from rosrm.extensions.declared_fields import declared_spec
from rosrm.extensions.plugin_calls import PluginCalls, given, required

#: Equal scores: the host with fewer processes goes first, then the one registered first.
TIE: Final = 1e-9
#: Sums of fractions are compared with this much tolerance.
CLOSE: Final = 1e-9

#: Of many hosts, so many that were nearly chosen are named beside the one that was.
RUNNERS_UP: Final = 3

#: Equal processes that a host may take one after the other are judged so many at a time.
_AT_A_TIME: Final = 8

T = TypeVar("T")

#: A scoring policy with its name.
NamedPolicy = tuple[str, ScoringPolicy]
Columns = slice | IntArray


class Ranking:
    """The judgement of every host for one demand, kept up to date column by column.

    Attributes:
        need: (R, H) fractions of each host's capacity.
        value: (H,) score plus tie-break; inf where the host does not fit now.
        judge: the policy that judges; None: every one was left out, all that fit score 0.
        plugins: guards every call of a policy.
        failure: why policies were left out.
    """

    def __init__(
        self, table: HostTable, policies: Sequence[NamedPolicy], demand: Demand,
        plugins: PluginCalls,
    ) -> None:  # fmt: skip
        self.table = table
        self.plugins = plugins
        self.demand = demand
        self.failure = ""
        self.version = table.version
        self.need = table.fractions(demand.amounts, demand.estimated)
        self._left = list(policies)
        self._spec = declared_spec(demand.spec, demand.reads)
        self._seen = len(table.touched)
        self._open = table.open() & eligible(table, demand)
        self._tier = _tiers(table, demand)
        self._lowest: list[int] | None = None
        self._own = -1
        self._ahead: dict[int, list[float]] = {}
        self.value = np.full(len(table), np.inf)
        self._judge(slice(0, len(table)))

    @property
    def judge(self) -> NamedPolicy | None:
        """The policy that judges now, with its name."""
        return self._left[0] if self._left else None

    @property
    def policy_name(self) -> str:
        """The name of the policy that judges, and which was left out, and why."""
        name = self._left[0][0] if self._left else ""
        if not self.failure:
            return name
        return f"{name} ({self.failure})" if name else self.failure

    def took(self) -> None:
        """The newest change of the table was an assignment of this very demand."""
        self._own = len(self.table.touched)

    def refresh(self) -> None:
        """Judge anew the columns that assignments have changed since."""
        touched = self.table.touched
        if len(touched) == self._seen:
            return
        columns = set(touched[self._seen :])
        alone = self._seen == len(touched) - 1
        self._seen = len(touched)
        if alone and self._own == len(touched):
            self._judge_ahead(columns.pop())
            return
        for column in columns & self._ahead.keys():
            del self._ahead[column]
        self._judge(np.fromiter(columns, np.int64, len(columns)))

    def best(self) -> int:
        """The column with the lowest value; -1: none fits."""
        best = self.lowest()
        return best[0] if best else -1

    def lowest(self) -> list[int]:
        """The few columns that fit with the lowest values, best first."""
        if self._lowest is None:
            self._lowest = self._find_lowest() if len(self.value) else []
        return self._lowest

    def _find_lowest(self) -> list[int]:
        value = self._preferred()
        found, were = [], []
        for _ in range(1 + RUNNERS_UP):
            column = int(value.argmin())
            was = value[column]
            if was == np.inf:
                break
            found.append(column)
            were.append(was)
            value[column] = np.inf  # one more argmin costs less than a sort
        value[found] = were
        return found

    def fits(self, column: int) -> bool:
        """True: this host may take it now."""
        return bool(self.value[column] < np.inf)

    def _judge(self, columns: Columns) -> None:
        """Set `value` of some columns."""
        self._lowest = None
        value = self._value(columns)
        if value is None:
            self._judge(slice(0, len(self.table)))  # scores of two policies do not compare
        else:
            self.value[columns] = value

    def _judge_ahead(self, column: int) -> None:
        """Set `value` of a column that just took a process of this demand.

        Thousands of equal processes may be waiting, so what the host will be worth with the next
        few of them is judged in one go, as if it were several hosts.
        """
        values = self._ahead.get(column)
        if not values:
            judged = self._value(np.full(_AT_A_TIME, column), np.arange(_AT_A_TIME))
            if judged is None:
                self._judge(slice(0, len(self.table)))
                return
            values = self._ahead[column] = judged[::-1].tolist()
        self._lowest = None
        self.value[column] = values.pop()

    def _value(self, columns: Columns, more: IntArray | None = None) -> FloatArray | None:
        """What some hosts are worth; None: the policy was left out, all are to be judged anew.

        `more`, (n,), supposes so many further processes of this demand on each host.
        """
        table = self.table
        need, processes = self.need[:, columns], table.processes[columns]
        cells = table.cells[:, :, columns]  # all planes at once: one copy costs less than three
        busy, limit = cells[BUSY], cells[LIMIT]
        if more is not None:
            busy, processes = busy + need * more, processes + more
        # A host without a resource has NaN there, which is over nothing.
        over = busy + need > limit - (self.demand.headroom - CLOSE)
        fits: BoolArray = ~np.logical_or.reduce(over)
        fits &= self._open[columns]
        fits &= processes < table.bound[columns]
        if not np.count_nonzero(fits):
            return np.full(len(fits), np.inf)
        tie = TIE * processes
        if not self._left:
            return np.where(fits, tie, np.inf)
        hosts = HostView(
            Names(table, columns), table.resources, _read_only(busy.T), _read_only(limit.T),
            _read_only(cells[CAPACITY].T), _read_only(processes[:]), Labels(table, columns),
        )  # fmt: skip
        process = ProcessView(self._spec, _read_only(need.T))
        name, policy = self._left[0]
        try:
            value, veto = self.plugins.ask(
                "scoring", name, "score", lambda: sound(policy.score(hosts, process), hosts, fits)
            )
        except PluginError as error:
            self._leave_out(error)
            return None
        if veto is not None:
            fits &= ~veto
        return np.where(fits, value + tie, np.inf)

    def _leave_out(self, error: PluginError) -> None:
        """The policy raised or answered nonsense: the next one decides, or none, and it is said."""
        name, _ = self._left.pop(0)
        reason = f"left out: {name!r}, {error}"
        self.failure = f"{self.failure}; {reason}" if self.failure else reason
        self._ahead.clear()

    def _preferred(self) -> FloatArray:
        """The values, only those of the best tier of labels that any fitting host is in."""
        if self._tier is None:
            return self.value
        fitting = self.value < np.inf
        if not fitting.any():
            return self.value
        best = self._tier[fitting].min()
        return np.where(self._tier == best, self.value, np.inf)


def _read_only(view: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Closes a view of a standing array to a policy that would write into it."""
    view.flags.writeable = False
    return view


def sound(scores: Scores, hosts: HostView, fits: BoolArray) -> tuple[FloatArray, BoolArray | None]:
    """The value and veto of an answer that keeps to the contract; raises for any other."""
    size = len(fits)
    required(scores, Scores)
    try:
        value = np.asarray(scores.value, np.float64)
    except (TypeError, ValueError):
        raise PluginError(
            f"answered scores that are no numbers: {given(scores.value)}; {size} numbers are "
            f"required, one for each host"
        ) from None
    if value.shape != (size,):
        raise PluginError(f"scores of shape {value.shape} for {size} hosts")
    veto = None
    asked = fits
    if scores.veto is not None:
        veto = np.asarray(scores.veto)
        if veto.shape != (size,):
            raise PluginError(f"vetoes of shape {veto.shape} for {size} hosts")
        if veto.dtype != np.bool_:
            raise PluginError(f"vetoes of type {veto.dtype}; booleans are required, True: vetoed")
        asked = fits & ~veto
    if np.count_nonzero(np.isfinite(value)) < size:
        wrong = np.flatnonzero(asked & ~np.isfinite(value))
        if len(wrong):
            row = int(wrong[0])
            raise PluginError(
                f"the score of host {hosts.names[row]} is {value[row]}{_unread_by(hosts, row)}"
            )
    return value, veto


def _unread_by(hosts: HostView, row: int) -> str:
    """Return what a host does not measure, as that is where a NaN comes from; "": nothing."""
    names = [
        name for name, usage in zip(hosts.resources, hosts.usage[row], strict=True)
        if np.isnan(usage)
    ]  # fmt: skip
    if not names:
        return ""
    return (
        f". It does not measure {', '.join(names)}, so `usage` and `capacity` are NaN there; "
        "`column` is not"
    )


class _PerHost(Sequence[T]):
    """Something of each host on demand: a thousand of them are not listed for each decision."""

    def __init__(self, table: HostTable, columns: Columns) -> None:
        self._hosts = table.hosts
        self._columns = columns

    def _list(self) -> Sequence[int]:
        if isinstance(self._columns, slice):
            return range(self._columns.start, self._columns.stop)
        return [int(column) for column in self._columns]

    def __len__(self) -> int:
        return len(self._list())

    def __getitem__(self, row: Any) -> Any:
        columns = self._list()[row]
        if isinstance(columns, int):
            return self._of(self._hosts[columns])
        return [self._of(self._hosts[column]) for column in columns]

    def _of(self, host: Host) -> T:
        raise NotImplementedError


class Names(_PerHost[str]):
    """The name of each host."""

    def _of(self, host: Host) -> str:
        return host.name


class Labels(_PerHost[Mapping[str, str]]):
    """The labels of each host."""

    def _of(self, host: Host) -> Mapping[str, str]:
        return MappingProxyType(dict(host.description.labels))


def eligible(table: HostTable, demand: Demand) -> BoolArray:
    """(H,) True: labels, exclusions and the resources that it has allow the host."""
    allowed = np.ones(len(table), np.bool_)
    for key, value in demand.spec.required_labels.items():
        allowed &= table.labelled(key, value)
    for name in demand.excluded:
        host = table.by_name.get(name)
        if host is not None:
            allowed[host.column] = False
    for resource in demand.declared:
        if resource not in table.resources:
            allowed[:] = False
        else:
            allowed &= table.capacity[table.resources.index(resource)] > 0.0
    return allowed


def _tiers(table: HostTable, demand: Demand) -> IntArray | None:
    """(H,) lower goes first: avoided labels count up, preferred ones down; None: all are alike."""
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
