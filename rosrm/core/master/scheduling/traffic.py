"""Load that the flows of a process would put on the links of hosts."""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master.state.demand import Traffic
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray, IntArray
from rosrm.core.master.state.links import LinkTable
from rosrm.extensions.link_views import FlowView

#: Tolerance in comparisons of sums of rates.
_CLOSE: Final = 1.0 - 1e-9


def keeping_limits(
    links: LinkTable, traffic: Traffic, hosts: int, *, empty: bool = False
) -> BoolArray | None:
    """Return the mask, (H,), of hosts whose links stay within their limits; None: none is known.

    `FlowView` has the same values with their parts; this function is faster for all hosts.

    Args:
        hosts: number of hosts.
        empty: True: as if nothing but the process used the links.
    """
    if not traffic.flows or not links.size:
        return None
    room = links.usable if empty else links.room
    if traffic.counted and not empty:
        room = links.usable - links.load_without(traffic.counted)
    known = min(hosts, links.size)
    rates: dict[int, float] = {}
    for flow in traffic.flows:
        rates[flow.column] = rates.get(flow.column, 0.0) + flow.rate
    first = links.cells[:known]
    near = {column: links.facing[links.row(column), :known] for column in rates}
    kept = np.ones(hosts, np.bool_)
    for column, rate in rates.items():
        added: float | FloatArray = rate
        for other, more in rates.items():
            if other != column:  # both may cross the same interface
                also = more * (near[other] == near[column])
                if other < known:
                    also[other] = 0.0
                added = added + also
        far = links.interface[links.row(column), :known]
        crosses = room.ravel().take(first + near[column]) >= added * _CLOSE
        crosses &= room[links.row(column)].take(far) >= rate * _CLOSE
        if column < known:
            crosses[column] = True
        kept[:known] &= crosses
    return kept


def flow_view(
    links: LinkTable, traffic: Traffic, columns: IntArray, *, empty: bool = False
) -> FlowView:
    """Return the flows of a process on each of N hosts, given by their columns.

    Args:
        empty: True: as if nothing but the process used the links.
    """
    flows, every = traffic.flows, np.arange(len(columns))
    load = np.zeros_like(links.load) if empty else links.load_without(traffic.counted)
    here = np.minimum(columns, links.size)
    is_local = columns[:, None] == np.array([flow.column for flow in flows], np.int64)
    there = [links.row(flow.column) for flow in flows]
    near = links.interface[here[:, None], there]
    added = np.zeros((len(columns), load.shape[1]))
    to_host: dict[int, float] = {}
    for at, flow in enumerate(flows):
        added[every, near[:, at]] += np.where(is_local[:, at], 0.0, flow.rate)
        to_host[flow.column] = to_host.get(flow.column, 0.0) + flow.rate
    far = links.interface[there, here[:, None]]
    ends = (
        (here[:, None], near, added[every[:, None], near]),
        (np.array(there, np.int64), far, np.array([to_host[flow.column] for flow in flows])),
    )
    rooms = [links.usable[row, at] - load[row, at] - more for row, at, more in ends]
    is_near = rooms[0] <= rooms[1]

    def chosen(near: FloatArray, far: FloatArray, local: float) -> FloatArray:
        """Return the values, (N, F), of the end with less room."""
        values = np.where(is_local, local, np.where(is_near, near, far))
        values.flags.writeable = False
        return values

    (first, near, _), (second, far, _) = ends
    rate, limit, used = (
        chosen(values[first, near], values[second, far], local)
        for values, local in (
            (links.rate, np.inf), (links.rate * links.limit[:, None], np.inf), (load, 0.0),
        )
    )  # fmt: skip
    return FlowView(
        tuple(flow.process for flow in flows), tuple(flow.host for flow in flows),
        np.array([flow.rate for flow in flows]),
        np.array([flow.incoming for flow in flows], np.bool_), is_local, rate, limit, used,
        chosen(ends[0][2], np.asarray(ends[1][2]), 0.0),
        np.where(is_local, 0.0, links.round_trip[here[:, None], there]),
    )  # fmt: skip


def round_trips(links: LinkTable, columns: IntArray, peers: IntArray) -> FloatArray:
    """Return the seconds of a round trip, (N, P), between hosts; NaN: not measured."""
    here, there = (np.minimum(one, links.size) for one in (columns, peers))
    return links.round_trip[here[:, None], there].astype(np.float64)


def rates(links: LinkTable, columns: IntArray, peers: IntArray) -> FloatArray:
    """Return the bytes a second, (N, P), that the links between hosts can carry; NaN: not known."""
    here, there = np.minimum(columns, links.size)[:, None], np.minimum(peers, links.size)
    near = links.rate[here, links.interface[here, there]]
    return np.fmin(near, links.rate[there, links.interface[there, here]])
