"""Eq. 1, with a veto above a threshold and a steep cost on the way there.

What is judged is how near to its limit each resource of a host would be with the process on it:
(reading + in-flight load + need) / limit, the nearest one counts. Up to `leave` Eq. 1 alone
decides. Between `leave` and `enter` a host costs more than any host below `leave` can, and the
steeper the fuller: it is taken only when all the others are there too, the least full first. Above
`enter` it is vetoed.

This is hysteresis without a memory, as a policy has none. A host that has reached the veto does not
get work again as soon as a reading dips below `enter`: before that it has to be below `leave`, or
every other host that fits has to be in the band as well. And as the need of the process counts
before it is there, a host that is filled up to `enter` has to lose that much again, not just a
reading's jitter, before an equal process is let in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Gt, Le

from rosrm import FloatArray, HostView, ProcessView, ResourceName, Scores
from rosrm_scoring.weighted import DEFAULT_WEIGHTS, Missing, Weight, WeightedSum

#: Stands for a limit of 0, which nothing can be divided by.
_SMALLEST_LIMIT: Final = 1e-9


@dataclass(frozen=True)
class ThresholdOptions:
    """Settings of the policy `threshold`.

    Attributes:
        weights: of Eq. 1, as those of the policy `weighted`.
        missing: as that of the policy `weighted`; what is not measured vetoes no host.
        enter: fraction of its limit above which a resource vetoes its host.
        leave: fraction of its limit up to which a resource costs nothing beyond Eq. 1.
        steepness: cost just below `enter`, where Eq. 1 gives at most the sum of the weights.
        watch: resources that veto; those that a process declares to need are watched for it too.
    """

    weights: Mapping[ResourceName, Weight] = field(default_factory=lambda: DEFAULT_WEIGHTS)
    missing: Missing = "worst"
    enter: Annotated[float, Gt(0), Le(1)] = 0.95
    leave: Annotated[float, Ge(0), Le(1)] = 0.8
    steepness: Annotated[float, Gt(0), Le(1e6)] = 10.0
    watch: tuple[ResourceName, ...] = ("memory", "cpu", "disk")

    def __post_init__(self) -> None:
        """Refuse a band without a width."""
        if not self.leave < self.enter:
            raise ValueError(f"leave ({self.leave:g}) must be below enter ({self.enter:g})")


class Threshold:
    """Implements `rosrm.extensions.contracts.ScoringPolicy`.

    Args:
        options: weights and band.
    """

    def __init__(self, options: ThresholdOptions) -> None:
        self._options = options
        self._sum = WeightedSum(options.weights, options.missing)
        # More than Eq. 1 can differ between two hosts below the band.
        self._step = 1.0 + self._sum.largest

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Eq. 1 below the band, a steep cost within, a veto above."""
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
        """(N,) 0 up to `leave`, from there quadratic up to `steepness` at `enter`."""
        options = self._options
        depth = (fill - options.leave) / (options.enter - options.leave)
        # A vetoed host may be over by any amount; its value must be finite all the same.
        np.minimum(np.maximum(depth, 0.0, out=depth), 1.0, out=depth)
        cost = depth * depth * options.steepness
        cost += self._step * (depth > 0.0)
        return np.asarray(cost)

    def _fill(self, hosts: HostView, process: ProcessView) -> FloatArray:
        """(N,) how near to its limit the nearest watched resource would be; 1 is at the limit."""
        nearest: FloatArray | None = None
        for index in self._watched(hosts, process):
            fill = hosts.column(hosts.resources[index]) + process.need[:, index]
            fill /= np.maximum(hosts.limit[:, index], _SMALLEST_LIMIT)
            # `fmax` passes over NaN: a need of what the host has not is the core's to refuse.
            nearest = fill if nearest is None else np.fmax(nearest, fill, out=nearest)
        return np.zeros(len(hosts.usage)) if nearest is None else np.nan_to_num(nearest)

    def _watched(self, hosts: HostView, process: ProcessView) -> list[int]:
        """Columns that count for this process. A busy GPU is no reason to refuse who needs none."""
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
        """The watched resource of one host that would be nearest to its limit, and how near."""
        fills = [("nothing", 0.0)]
        for index in self._watched(hosts, process):
            used = np.nan_to_num(hosts.usage[row, index]) + process.need[row, index]
            fill = used / max(hosts.limit[row, index], _SMALLEST_LIMIT)
            fills.append((hosts.resources[index], float(np.nan_to_num(fill))))
        return max(fills, key=lambda named: named[1])
