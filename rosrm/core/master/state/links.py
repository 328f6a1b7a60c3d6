"""Links between hosts: their measured values, and the flows of processes that cross them.

A link joins two hosts through one interface of each. What a link can carry is what the narrower of
its two interfaces can carry, and all links of an interface share its rate. A value that was not
measured is NaN: it excludes no host.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from rosrm.core.master.state.host_arrays import FloatArray
from rosrm.model.links import INTERFACES, Interface

#: Most hosts with measured links: the tables have this number squared as cells.
MOST_HOSTS: Final = 2048
#: Interface of a host towards a host to which no link was measured.
UNKNOWN: Final = INTERFACES


class Crossing(NamedTuple):
    """A flow between two hosts, by their columns: B/s."""

    here: int
    there: int
    rate: float


class LinkTable:
    """Arrays over hosts H (by column) and interfaces K of one host, of which the last is unknown.

    Their size is that of the measured hosts; one more row stands for all other hosts.

    Attributes:
        round_trip: (H, H) seconds from host to host and back; NaN: not measured.
        interface: (H, H) interface of a host towards another one; UNKNOWN: not measured.
        facing: (H, H) the interface of the other one: `interface`, transposed.
        rate: (H, K) bytes a second that the interface can carry; NaN: not known.
        allowed: (H, K) bytes a second that flows may use; NaN: not known.
        traffic: (H, K) bytes a second that the interface carries, as measured.
        flowing: (H, K) sum of the known flows that cross the interface, bytes a second.
        limit: (H,) fraction of the rate that flows may use.
        usable: (H, K) `allowed`, or inf.
        load: (H, K) the greater one of `traffic` and `flowing`.
        room: (H, K) `usable` without `load`; inf: not known.
        least_room: (H,) the least room of the host's interfaces.
        cells: (H,) index of the first cell of each host in the flat (H, K) arrays.
        crossings: pair of processes to the flow between their hosts.
        version: counter of changes.
    """

    def __init__(self) -> None:
        self.crossings: dict[Hashable, Crossing] = {}
        self.version = 0
        self._allocate(0)

    def _allocate(self, hosts: int) -> None:
        side = hosts + 1
        self.round_trip: npt.NDArray[np.float32] = np.full((side, side), np.nan, np.float32)
        self.interface: npt.NDArray[np.int8] = np.full((side, side), UNKNOWN, np.int8)
        self.rate: FloatArray = np.full((side, UNKNOWN + 1), np.nan)
        self.traffic: FloatArray = np.zeros((side, UNKNOWN + 1))
        self.flowing: FloatArray = np.zeros((side, UNKNOWN + 1))
        self.load: FloatArray = np.zeros((side, UNKNOWN + 1))
        self.allowed: FloatArray = self.rate.copy()
        self.usable: FloatArray = np.full((side, UNKNOWN + 1), np.inf)
        self.room: FloatArray = self.usable.copy()
        self.least_room: FloatArray = np.full(side, np.inf)
        self.cells = np.arange(side) * (UNKNOWN + 1)
        self.limit: FloatArray = np.ones(side)
        self.facing = self.interface.T.copy()

    @property
    def size(self) -> int:
        """Return the number of columns in the tables."""
        return len(self.limit) - 1

    def row(self, column: int) -> int:
        """Return the row of a host in the tables."""
        return min(column, self.size)

    def load_without(self, own: Iterable[Crossing]) -> FloatArray:
        """Return the load, (H, K), without some of the flows that it includes."""
        load = self.load
        for crossing in own:
            load = load.copy() if load is self.load else load
            for row, number in self.ends(crossing):
                load[row, number] = max(0.0, load[row, number] - crossing.rate)
        return load

    # --- measurements --------------------------------------------------------------------

    def store(
        self, column: int, interfaces: Sequence[Interface], limit: float,
        peers: Mapping[int, tuple[int, float]],
    ) -> None:  # fmt: skip
        """Store what a host has measured.

        Args:
            interfaces: of the host.
            limit: fraction of their rates that flows may use.
            peers: column of another host to the interface and the round trip (NaN: no answer).
        """
        if column >= MOST_HOSTS:
            return
        peers = {peer: found for peer, found in peers.items() if peer < MOST_HOSTS}
        most = max(column, *peers, 0)
        if most >= self.size:
            self._grow(most + 1)
        self.rate[column] = np.nan
        self.traffic[column] = 0.0
        for number, one in enumerate(interfaces):
            self.rate[column, number], self.traffic[column, number] = one.rate, one.traffic
        self.limit[column] = limit
        for peer, (number, seconds) in peers.items():
            self.interface[column, peer] = number
            self.round_trip[column, peer] = self.round_trip[peer, column] = seconds
        self._count_again()

    def forget(self, column: int) -> None:
        """Forget the measurements of a host whose slave starts again, or that was removed."""
        if column < self.size:
            self.round_trip[column, :] = self.round_trip[:, column] = np.nan
            self.interface[column, :] = self.interface[:, column] = UNKNOWN
            self.rate[column], self.traffic[column], self.limit[column] = np.nan, 0.0, 1.0
            self._count_again()

    def _grow(self, hosts: int) -> None:
        before, former = self.size, self.__dict__.copy()
        self._allocate(min(max(hosts, 2 * before, 8), MOST_HOSTS))
        for name in ("round_trip", "interface"):
            getattr(self, name)[:before, :before] = former[name][:before, :before]
        for name in ("rate", "traffic", "limit"):
            getattr(self, name)[:before] = former[name][:before]

    # --- flows ---------------------------------------------------------------------------

    def note(self, pair: Hashable, crossing: Crossing | None) -> None:
        """Note the flow between two processes; None: it crosses no link."""
        before = self.crossings.get(pair)
        if before == crossing:
            return
        if before is not None:
            del self.crossings[pair]
            self._add(before, -before.rate)
        if crossing is not None:
            self.crossings[pair] = crossing
            self._add(crossing, crossing.rate)
        self.version += 1

    def _count_again(self) -> None:
        """Add up all flows again, because rates or the interfaces between hosts have changed."""
        self.allowed = self.rate * self.limit[:, None]
        self.usable = np.where(np.isnan(self.allowed), np.inf, self.allowed)
        self.facing = self.interface.T.copy()
        self.flowing[:] = 0.0
        self.load[:] = self.traffic
        np.subtract(self.usable, self.load, out=self.room)
        self.room.min(axis=1, out=self.least_room)
        for crossing in self.crossings.values():
            self._add(crossing, crossing.rate)
        self.version += 1

    def _add(self, crossing: Crossing, rate: float) -> None:
        for row, number in self.ends(crossing):
            flowing = self.flowing[row, number] = max(0.0, self.flowing[row, number] + rate)
            load = self.load[row, number] = max(flowing, self.traffic[row, number])
            self.room[row, number] = self.usable[row, number] - load
            self.least_room[row] = self.room[row].min()

    def ends(self, crossing: Crossing) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return row and interface of both ends of a flow."""
        here, there = self.row(crossing.here), self.row(crossing.there)
        return (
            (here, int(self.interface[here, there])),
            (there, int(self.interface[there, here])),
        )
