"""Scoring policy `threshold`: Eq. 1 with a steep cost near a limit and a veto at the limit.

The policy computes how near each resource of a host would be to its limit with the process on it:
(reading + in-flight load + need) / limit. The largest of these values counts. Up to `leave` Eq. 1
alone decides. Between `leave` and `enter` a host costs more than any host below `leave`, and the
cost grows with the value. So such a host is chosen only if all others are in the band too, and then
the least full one. Above `enter` the policy vetoes the host.

This is hysteresis without state, because a policy has none. A host that was vetoed does not get
work as soon as a reading falls below `enter`: it must fall below `leave`, or every other host that
fits must be in the band too. The need of the process counts before the process starts. So a host
that is filled up to `enter` must free as much as the process needs before it accepts an equal one;
jitter of a reading is not enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Gt, Le

from rosrm import FloatArray, HostView, ProcessView, ResourceName, Scores
from rosrm_scoring.weighted import DEFAULT_WEIGHTS, Missing, Weight, WeightedSum

#: Replaces the need of a resource that a host lacks, which is infinite.
_WITHOUT: Final = 1e9
#: Replaces a limit of 0, to avoid a division by zero.
_SMALLEST_LIMIT: Final = 1e-9


@dataclass(frozen=True)
class ThresholdOptions:
    """Settings of the policy `threshold`.

    Attributes:
        weights: of Eq. 1, as those of the policy `weighted`.
        missing: as that of the policy `weighted`; a resource that is not measured vetoes no host.
        enter: fraction of its limit above which a resource vetoes its host.
        leave: fraction of its limit up to which a resource costs nothing beyond Eq. 1.
        steepness: cost just below `enter`; Eq. 1 gives at most the sum of the weights.
        watch: resources that can veto; for each process, those that it needs as well.
    """

    weights: Mapping[ResourceName, Weight] = field(default_factory=lambda: DEFAULT_WEIGHTS)
    missing: Missing = "worst"
    enter: Annotated[float, Gt(0), Le(1)] = 0.95
    leave: Annotated[float, Ge(0), Le(1)] = 0.8
    steepness: Annotated[float, Gt(0), Le(1e6)] = 10.0
    watch: tuple[ResourceName, ...] = ("memory", "cpu", "disk")

    def __post_init__(self) -> None:
        """Raise `ValueError` unless `leave` is below `enter`."""
        if not self.leave < self.enter:
            raise ValueError(f"leave ({self.leave:g}) must be below enter ({self.enter:g})")


class Threshold:
    """Implementation of `rosrm.extensions.contracts.ScoringPolicy`.

    Args:
        options: weights and band.
    """

    def __init__(self, options: ThresholdOptions) -> None:
        self._options = options
        self._sum = WeightedSum(options.weights, options.missing)
        # Larger than the largest difference of Eq. 1 between two hosts below the band.
        self._step = 1.0 + self._sum.largest

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Return Eq. 1 below the band, a steep cost within the band, and a veto above it."""
        options = self._options
        value = self._sum.of(hosts)
        fill = self._fill(hosts, process)
        veto = fill > options.enter
        if (fill > options.leave).any():
            value = value + self._cost(fill)
        return Scores(
            value,
            veto,
            veto_reason=lambda row: self._veto_reason(hosts, process, row),
            reason=lambda row: self._reason(hosts, process, row),
        )

    def _cost(self, fill: FloatArray) -> FloatArray:
        """Return (N,): 0 up to `leave`, from there quadratic up to `steepness` at `enter`."""
        options = self._options
        depth = (fill - options.leave) / (options.enter - options.leave)
        # A vetoed host may exceed the limit by any amount, but its value must be finite.
        np.minimum(np.maximum(depth, 0.0, out=depth), 1.0, out=depth)
        cost = depth * depth * options.steepness
        cost += self._step * (depth > 0.0)
        return np.asarray(cost)

    def _fill(self, hosts: HostView, process: ProcessView) -> FloatArray:
        """Return (N,): largest fraction of a limit that a watched resource would use; 1: full."""
        nearest: FloatArray | None = None
        for index in self._watched(hosts, process):
            fill = hosts.column(hosts.resources[index]) + process.need[:, index]
            fill /= np.maximum(hosts.limit[:, index], _SMALLEST_LIMIT)
            # `fmax` ignores NaN, because the core refuses hosts that lack a needed resource.
            nearest = fill if nearest is None else np.fmax(nearest, fill, out=nearest)
        if nearest is None:
            return np.zeros(len(hosts.usage))
        return np.nan_to_num(nearest, posinf=_WITHOUT)

    def _watched(self, hosts: HostView, process: ProcessView) -> list[int]:
        """Return the columns that count for this process.

        A busy GPU, for example, does not veto a process that needs none.
        """
        needed = [name for name, amount in process.spec.needs.items() if amount > 0]
        names = dict.fromkeys((*self._options.watch, *needed))
        return [hosts.resources.index(name) for name in names if name in hosts.resources]

    def _veto_reason(self, hosts: HostView, process: ProcessView, row: int) -> str:
        name, fill = self._nearest(hosts, process, row)
        return f"{name} would be at {fill:.1%} of its limit, over {self._options.enter:.0%}"

    def _reason(self, hosts: HostView, process: ProcessView, row: int) -> str:
        reason = self._sum.reason(hosts, row)
        name, fill = self._nearest(hosts, process, row)
        if fill <= self._options.leave:
            return reason
        cost = float(self._cost(np.array([fill]))[0])
        return f"{reason} + {cost:.2f}, as {name} would be at {fill:.1%} of its limit"

    def _nearest(self, hosts: HostView, process: ProcessView, row: int) -> tuple[str, float]:
        """Return the watched resource of one host nearest to its limit, as name and fraction."""
        fills = [("nothing", 0.0)]
        for index in self._watched(hosts, process):
            used = np.nan_to_num(hosts.usage[row, index]) + process.need[row, index]
            fill = used / max(hosts.limit[row, index], _SMALLEST_LIMIT)
            fills.append((hosts.resources[index], float(np.nan_to_num(fill, posinf=_WITHOUT))))
        return max(fills, key=lambda named: named[1])
