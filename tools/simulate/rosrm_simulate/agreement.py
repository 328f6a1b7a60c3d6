"""Agreement of a simulation with the run that it simulates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rosrm.core.master.state.host_arrays import FloatArray
from rosrm_simulate.meter import MEASURED, Curves, Outcome

#: Moments at which the curves of two runs are compared.
_MOMENTS = 500


@dataclass(frozen=True, slots=True)
class Agreement:
    """Two runs of the same workload, compared.

    Attributes:
        processes: that got a host in either run.
        same_host: of those, part whose first host is the same; a process without a host in one of
            the runs does not count as the same.
        same_counts: part of the processes whose first host may stay, if the number of processes of
            each host (and of no host at all) is to become the same in both runs.
        usage: by resource, mean distance of the usage of the same host at the same time, fraction.
        ranked: the same for the k-th fullest hosts of both runs.
        balance: by resource, mean distance of fullest minus emptiest host at the same time.
        makespan: of the second run, as a part of the first's; None: one of them has none.
        migrations: of the first and of the second.
    """

    processes: int
    same_host: float
    same_counts: float
    usage: Mapping[str, float]
    ranked: Mapping[str, float]
    balance: Mapping[str, float]
    makespan: float | None
    migrations: tuple[int, int]


def compare(first: Outcome, second: Outcome) -> Agreement:
    """Compare a run with another one that was measured over the same time."""
    placed = [*first.placements, *(one for one in second.placements if one not in first.placements)]
    here, there = ([_first_host(run, name) for name in placed] for run in (first, second))
    same = sum(one == other for one, other in zip(here, there, strict=True))
    moved = sum(abs(here.count(host) - there.count(host)) for host in {*here, *there}) / 2
    apart = {name: _distances(first.curves, second.curves, name) for name in MEASURED}
    known = first.makespan is not None and second.makespan is not None and first.makespan > 0.0
    return Agreement(
        len(placed),
        same / len(placed) if placed else 1.0, 1.0 - moved / len(placed) if placed else 1.0,
        {name: one.usage for name, one in apart.items()},
        {name: one.ranked for name, one in apart.items()},
        {name: one.balance for name, one in apart.items()},
        (second.makespan or 0.0) / (first.makespan or 1.0) if known else None,
        (first.migrations, second.migrations),
    )  # fmt: skip


def _first_host(run: Outcome, process: str) -> str | None:
    hosts = run.placements.get(process)
    return None if hosts is None else hosts[0]


class _Apart(NamedTuple):
    """The mean distances of two runs in one resource; 0: they have nothing in common."""

    usage: float = 0.0
    ranked: float = 0.0
    balance: float = 0.0


def _distances(first: Curves, second: Curves, resource: str) -> _Apart:
    hosts = [name for name in first.hosts if name in second.hosts]
    if not len(first.times) or not len(second.times) or not hosts:
        return _Apart()
    begin = max(0.0, first.times[0], second.times[0])
    moments = np.linspace(begin, min(first.times[-1], second.times[-1]), _MOMENTS)
    one, other = (_at(curves, resource, hosts, moments) for curves in (first, second))
    there = ~(np.isnan(one) | np.isnan(other))
    some = there.any(axis=1)
    if not some.any():
        return _Apart()
    # Sorted by fullness; NaN (the host is absent in one of them) goes last in both.
    one, other = (np.where(there, values, np.nan)[some] for values in (one, other))
    one_ranked, other_ranked = np.sort(one, axis=1), np.sort(other, axis=1)
    return _Apart(
        float(np.nanmean(np.abs(one - other))),
        float(np.nanmean(np.abs(one_ranked - other_ranked))),
        float(np.abs(_gap(one) - _gap(other)).mean()),
    )


def _at(curves: Curves, resource: str, hosts: list[str], moments: FloatArray) -> FloatArray:
    """Return the (M, H) usage of hosts at moments: the newest sample holds."""
    columns = [curves.hosts.index(name) for name in hosts]
    rows = np.clip(np.searchsorted(curves.times, moments, side="right") - 1, 0, None)
    found: FloatArray = curves.usage[resource][rows][:, columns]
    return found


def _gap(usage: FloatArray) -> FloatArray:
    gap: FloatArray = np.nanmax(usage, axis=1) - np.nanmin(usage, axis=1)
    return gap
