"""Scoring policy `network`: hosts that keep flows local, and links below their limits.

score = local * remote part + load * usage of the fullest link + latency * round trip / scale

The remote part is the share of the process's traffic (0..1) that would leave the host. The usage is
that of the link with the least room, as a share of what flows may use of it (1: at its limit); the
round trip is the mean over the traffic, as a share of `round_trip`, at most 1. A process without
flows scores 0 on every host, so the policy adds nothing to others in a chain. Alone, it then leaves
the choice to the core, which picks the host with the fewest processes.

A link of unknown rate counts as full, and one of unknown round trip as slow (`missing: worst`).
Otherwise a host without measurements would look nearer than every host that has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le

from rosrm import FloatArray, FlowView, HostView, PositiveSeconds, ProcessView, Scores

Weight = Annotated[float, Ge(0), Le(1)]
Missing = Literal["worst", "ignore"]

#: Value that counts where a link was not measured.
_COUNTS_AS: Final[Mapping[Missing, float]] = {"worst": 1.0, "ignore": 0.0}
#: A link over its limit counts at most as this many full ones.
_MOST_USED: Final = 10.0


@dataclass(frozen=True)
class NetworkOptions:
    """Settings of the policy `network`.

    Attributes:
        local: weight of the part of the traffic that would leave the host.
        load: weight of the usage of the fullest link.
        latency: weight of the round trip.
        round_trip: round trip that counts as 1, in seconds.
        missing: "worst" counts a link that was not measured as full and slow; "ignore" as empty.
    """

    local: Weight = 1.0
    load: Weight = 0.5
    latency: Weight = 0.5
    round_trip: PositiveSeconds = 0.1
    missing: Missing = "worst"


class Network:
    """Implementation of `rosrm.extensions.contracts.ScoringPolicy` by the flows of the process.

    Args:
        options: weights and scale.
    """

    def __init__(self, options: NetworkOptions) -> None:
        self._options = options
        self._missing = _COUNTS_AS[options.missing]

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Return the cost of the traffic on each host; 0 for a process without flows."""
        flows = process.flows
        if not len(flows.rate):
            return Scores(np.zeros(len(hosts.usage)), reason=lambda _row: "no flows")
        remote, used, slow = self._remote(flows), self._used(flows), self._slow(flows)
        options = self._options
        value = options.local * remote + options.load * used + options.latency * slow

        def reason(row: int) -> str:
            terms = (
                (options.local, "remote part", remote), (options.load, "link usage", used),
                (options.latency, "round trip", slow),
            )  # fmt: skip
            shown = " + ".join(
                f"{weight:g} x {name} {values[row]:.1%}" for weight, name, values in terms if weight
            )
            crossing = [
                flows.describe(row, one) for one in np.flatnonzero(~flows.is_local[row]).tolist()
            ]
            return "; ".join((shown, *crossing[:3]))

        return Scores(value, reason=reason)

    def _remote(self, flows: FlowView) -> FloatArray:
        """Return (N,): the share of the traffic that would leave each host."""
        return _mean(np.where(flows.is_local, 0.0, 1.0), flows.rate)

    def _used(self, flows: FlowView) -> FloatArray:
        """Return (N,): the usage of the fullest link; 0 where all flows are local."""
        used = (flows.link_load + flows.added) / flows.link_limit
        used = np.where(np.isnan(used), self._missing, np.minimum(used, _MOST_USED))
        return np.asarray(np.where(flows.is_local, 0.0, used).max(axis=1))

    def _slow(self, flows: FlowView) -> FloatArray:
        """Return (N,): the mean round trip of the traffic as a share of the scale, at most 1."""
        share = np.minimum(flows.round_trip / self._options.round_trip, 1.0)
        return _mean(np.where(np.isnan(share), self._missing, share), flows.rate)


def _mean(values: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the mean, (N,), over the traffic of (N, F) values.

    The columns are added one by one, because the rounding of numpy's sum may depend on the number
    of rows, and the score of a host must not.
    """
    total = np.zeros(len(values))
    for column, much in zip(values.T, rate.tolist(), strict=True):
        total += column * much
    return np.asarray(total / sum(rate.tolist()))
