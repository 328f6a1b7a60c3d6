"""Links and flows as scoring policies read them: arrays over hosts, with NaN where not measured.

Slaves and commands import this module. So it imports numpy only where it makes an array.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rosrm.extensions.array_types import BoolArray, FloatArray


class LinkView(Protocol):
    """Links from N hosts to all H hosts of the cluster, for a scoring policy.

    The arrays are computed when they are read. A link to the host itself has a round trip of 0 and
    a rate of inf.
    """

    @property
    def hosts(self) -> Sequence[str]:
        """Return the H names of the columns."""

    @property
    def round_trip(self) -> FloatArray:
        """Return (N, H): seconds from host to host and back; NaN: not measured."""

    @property
    def rate(self) -> FloatArray:
        """Return (N, H): bytes a second that the link can carry; NaN: not known."""


@dataclass(frozen=True)
class MeasuredLinks:
    """`LinkView` with given arrays, for views that are made by hand."""

    hosts: Sequence[str]
    round_trip: FloatArray
    rate: FloatArray


@cache
def no_links() -> LinkView:
    """Return a `LinkView` without hosts."""
    import numpy as np  # noqa: PLC0415 - see above

    return MeasuredLinks((), np.zeros((0, 0)), np.zeros((0, 0)))


@dataclass(frozen=True)
class FlowView:
    """The F flows between a process and others that have a host, on each of N hosts.

    The load of a link is the greater one of its measured traffic and the sum of all known flows
    across it. Of the two interfaces of a link, the values are those of the one with less room.

    Attributes:
        processes: F names of the other processes.
        hosts: F names of their hosts.
        rate: (F,) bytes a second.
        incoming: (F,) True: the process receives the flow, or declares it.
        is_local: (N, F) True: the other process runs on the host.
        link_rate: (N, F) bytes a second that the link can carry; NaN: not known; inf: local.
        link_limit: (N, F) bytes a second that flows may use of it; NaN and inf as in `link_rate`.
        link_load: (N, F) bytes a second on the link without this process; 0 where not known.
        added: (N, F) bytes a second that all flows of this process would add to the link.
        round_trip: (N, F) seconds from host to host and back; NaN: not measured; 0: local.
    """

    processes: Sequence[str]
    hosts: Sequence[str]
    rate: FloatArray
    incoming: BoolArray
    is_local: BoolArray
    link_rate: FloatArray
    link_limit: FloatArray
    link_load: FloatArray
    added: FloatArray
    round_trip: FloatArray

    def is_over(self) -> BoolArray:
        """Return (N, F): True where the link would be over its limit; False where NaN."""
        over: BoolArray = self.link_load + self.added > self.link_limit * (1.0 + 1e-9)
        return over

    def describe(self, row: int, flow: int) -> str:
        """Return a sentence on the link that a flow would cross from the host of a row."""
        word = "from" if self.incoming[flow] else "to"
        what = f"{_per_second(self.rate[flow])} {word} {self.processes[flow]}"
        where = f"{what} on {self.hosts[flow]}"
        if self.is_local[row, flow]:
            return f"{what} stay on the host"
        rate, limit = self.link_rate[row, flow], self.link_limit[row, flow]
        if math.isnan(rate):
            return f"{where} would cross a link of unknown rate"
        load, others = self.link_load[row, flow], self.added[row, flow] - self.rate[flow]
        facts = [f"{_per_second(load)} in use"] * bool(load >= 1.0)
        facts += [f"{_per_second(others)} for other flows of it"] * bool(others >= 1.0)
        if limit < rate:
            facts.insert(0, f"{_per_second(limit)} may be used")
        return f"{where} would cross a {_per_second(rate)} link" + (
            f" ({', '.join(facts)})" if facts else ""
        )


def _per_second(rate: float) -> str:
    for size, unit in ((1e9, "GB/s"), (1e6, "MB/s"), (1e3, "kB/s")):
        if rate >= size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g} B/s"


@cache
def no_flows() -> FlowView:
    """Return a `FlowView` without flows, whose sums are 0 for any number of hosts."""
    import numpy as np  # noqa: PLC0415 - see above

    return FlowView(
        (), (), np.zeros(0), np.zeros(0, np.bool_), np.zeros((1, 0), np.bool_),
        *(np.zeros((1, 0)) for _ in range(5)),
    )  # fmt: skip
