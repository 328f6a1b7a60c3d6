"""Eq. 1 of the paper: score = w_mem * memusage + w_cpu * cpuusage + w_disk * diskusage.

The administrator chooses the weights, each from 0 to 1. By default memory weighs 1, cpu 0.5 and
disk 0: memory that runs out kills processes, so it counts most; cpu that runs out only slows them,
and its reading swings, so it counts half, which is enough to keep jobs that compute off a host that
computes already; how full a disk is says little about what one more process would find there. The
limits hold whatever the weights are.

A host that does not measure a resource that weighs counts as full of it (`missing: worst`):
otherwise a host without the probe would look emptier than every host that has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le

from rosrm import FloatArray, HostView, ProcessView, ResourceName, Scores

Weight = Annotated[float, Ge(0), Le(1)]
Missing = Literal["worst", "ignore"]

#: The usage that counts where a host does not measure a resource.
_COUNTS_AS: Final[Mapping[Missing, float]] = {"worst": 1.0, "ignore": 0.0}

DEFAULT_WEIGHTS: Final[Mapping[str, Weight]] = MappingProxyType(
    {"memory": 1.0, "cpu": 0.5, "disk": 0.0}
)


@dataclass(frozen=True)
class WeightedOptions:
    """Settings of the policy `weighted`.

    Attributes:
        weights: by resource, 0..1; a resource that is not named weighs 0, so what is given here
            replaces the defaults as a whole.
        missing: how a resource counts that a host does not measure: "worst", as if it were full, or
            "ignore", as if it were empty, for what some hosts do not have by design.
    """

    weights: Mapping[ResourceName, Weight] = field(default_factory=lambda: DEFAULT_WEIGHTS)
    missing: Missing = "worst"


class Weighted:
    """Implements `rosrm.extensions.contracts.ScoringPolicy` by Eq. 1.

    Args:
        options: the weights.
    """

    def __init__(self, options: WeightedOptions) -> None:
        self._sum = WeightedSum(options.weights, options.missing)

    def score(self, hosts: HostView, process: ProcessView) -> Scores:  # noqa: ARG002 - by usage alone
        """The weighted sum of the usages; the host with the most room has the lowest."""
        return Scores(self._sum.of(hosts), reason=lambda row: self._sum.reason(hosts, row))


class WeightedSum:
    """Eq. 1 for any number of hosts at once.

    Args:
        weights: by resource, 0..1.
        missing: as in `WeightedOptions`.
    """

    def __init__(self, weights: Mapping[str, float], missing: Missing = "worst") -> None:
        self._missing = _COUNTS_AS[missing]
        self._weights = {name: weight for name, weight in weights.items() if weight > 0}
        self.largest: Final = sum(self._weights.values())

    def of(self, hosts: HostView) -> FloatArray:
        """(N,) the sum for each host; what no host measures makes no difference.

        One column after another, never as a matrix product: its rounding depends on the number of
        rows, and a host must score alike alone and among others.
        """
        total: FloatArray | None = None
        for name, weight in self._weights.items():
            if name not in hosts.resources:
                continue
            term = hosts.column(name, self._missing)
            term *= weight
            total = term if total is None else np.add(total, term, out=total)
        return np.zeros(len(hosts.usage)) if total is None else total

    def reason(self, hosts: HostView, row: int) -> str:
        """The sum of one host, written out."""
        terms = []
        for name, weight in self._weights.items():
            if name in hosts.resources:
                usage = float(hosts.usage[row, hosts.resources.index(name)])
                said = f"{usage:.1%}"
                if np.isnan(usage):
                    said = f"{self._missing:.1%} (not measured there)"
                terms.append(f"{weight:g} x {name} {said}")
        return " + ".join(terms) or "no resource that weighs is read on any host"
