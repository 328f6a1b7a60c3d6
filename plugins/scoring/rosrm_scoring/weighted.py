"""Scoring policy `weighted`, Eq. 1 of the paper.

score = w_mem * memusage + w_cpu * cpuusage + w_disk * diskusage

The administrator chooses the weights, each from 0 to 1. By default memory weighs 1, cpu 0.5 and
disk 0. Memory counts most, because exhausted memory kills processes. Exhausted cpu only slows them,
and its reading fluctuates, so it counts half; that is enough to keep computing jobs off a host that
computes already. Disk usage says little about the performance of one more process. The limits
apply independently of the weights.

A host that does not measure a weighted resource counts as full of it (`missing: worst`), because
otherwise a host without the probe would look emptier than every host that has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isnan
from types import MappingProxyType
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le

from rosrm import FloatArray, HostView, ProcessView, ResourceName, Scores

Weight = Annotated[float, Ge(0), Le(1)]
Missing = Literal["worst", "ignore"]

#: Usage that counts if a host does not measure a resource.
_COUNTS_AS: Final[Mapping[Missing, float]] = {"worst": 1.0, "ignore": 0.0}

DEFAULT_WEIGHTS: Final[Mapping[str, Weight]] = MappingProxyType(
    {"memory": 1.0, "cpu": 0.5, "disk": 0.0}
)


@dataclass(frozen=True)
class WeightedOptions:
    """Settings of the policy `weighted`.

    Attributes:
        weights: by resource, 0..1; a resource that is not named weighs 0, so the given mapping
            replaces the defaults as a whole.
        missing: usage of a resource that a host does not measure: "worst" counts it as full;
            "ignore" counts it as empty, for resources that some hosts lack by design.
    """

    weights: Mapping[ResourceName, Weight] = field(default_factory=lambda: DEFAULT_WEIGHTS)
    missing: Missing = "worst"


class Weighted:
    """Implementation of `rosrm.extensions.contracts.ScoringPolicy` by Eq. 1.

    Args:
        options: the weights.
    """

    def __init__(self, options: WeightedOptions) -> None:
        self._sum = WeightedSum(options.weights, options.missing)

    def score(self, hosts: HostView, process: ProcessView) -> Scores:  # noqa: ARG002 - by usage alone
        """Return the weighted sum of the usages; the host with the most room has the lowest."""
        return Scores(self._sum.of(hosts), reason=lambda row: self._sum.reason(hosts, row))


class WeightedSum:
    """Weighted sum of Eq. 1 for any number of hosts at once.

    Args:
        weights: by resource, 0..1.
        missing: as in `WeightedOptions`.
    """

    def __init__(self, weights: Mapping[str, float], missing: Missing = "worst") -> None:
        self._missing = _COUNTS_AS[missing]
        self._weights = {name: weight for name, weight in weights.items() if weight > 0}
        self.largest: Final = sum(self._weights.values())

    def of(self, hosts: HostView) -> FloatArray:
        """Return (N,): the sum for each host; a resource that no host measures is left out.

        The columns are added one by one. The rounding of a matrix product depends on the number of
        rows, but the score of a host must not depend on the other hosts.
        """
        total: FloatArray | None = None
        for name, weight in self._weights.items():
            if name not in hosts.resources:
                continue
            term = hosts.column(name, self._missing)
            if weight != 1.0:
                term *= weight
            total = term if total is None else np.add(total, term, out=total)
        return np.zeros(len(hosts.usage)) if total is None else total

    def reason(self, hosts: HostView, row: int) -> str:
        """Return the terms of one host's sum as text."""
        terms = []
        for name, weight in self._weights.items():
            if name in hosts.resources:
                usage = float(hosts.usage[row, hosts.resources.index(name)])
                shown = f"{usage:.1%}"
                if isnan(usage):
                    shown = f"{self._missing:.1%} (not measured there)"
                terms.append(f"{weight:g} x {name} {shown}")
        return " + ".join(terms) or "no resource that weighs is read on any host"
