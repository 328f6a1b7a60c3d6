"""Load that the flows of a process would put on the links of hosts."""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master.state.demand import Flow, Traffic
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray, IntArray
from rosrm.core.master.state.links import LinkTable
from rosrm.extensions.link_views import FlowView

#: Tolerance in comparisons of sums of rates.
_CLOSE: Final = 1.0 - 1e-9
#: A learned flow counts as at most this share of what flows may use of a link. Otherwise two nodes
#: that exchange more in the memory of one host could never leave it.
_MOST_LEARNED: Final = 0.5


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
    by_host: dict[int, list[Flow]] = {}
    for flow in traffic.flows:
        by_host.setdefault(flow.column, []).append(flow)
    first, usable = links.cells[:known], links.usable.ravel()
    near = {column: links.facing[links.row(column), :known] for column in by_host}
    kept = np.ones(hosts, np.bool_)
    for column, flows in by_host.items():
        cell = first + near[column]
        added = sum(_counts_as(flow, usable, cell) for flow in flows)
        for other, more in by_host.items():
            if other != column:  # both may cross the same interface
                also = sum(_counts_as(flow, usable, cell) for flow in more)
                also = also * (near[other] == near[column])
                if other < known:
                    also[other] = 0.0
                added = added + also
        far = links.cells[links.row(column)] + links.interface[links.row(column), :known]
        received = sum(_counts_as(flow, usable, far) for flow in flows)
        crosses = room.ravel().take(cell) >= added * _CLOSE
        crosses &= room.ravel().take(far) >= received * _CLOSE
        if column < known:
            crosses[column] = True
        kept[:known] &= crosses
    return kept


def _counts_as(flow: Flow, usable: FloatArray, cells: IntArray) -> float | FloatArray:
    """Return the bytes a second as which a flow counts on interfaces, given by their cells."""
    if not flow.learned:
        return flow.rate
    return np.minimum(flow.rate, _MOST_LEARNED * usable.take(cells))


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
    far = links.interface[there, here[:, None]]
    added, usable = np.zeros((len(columns), load.shape[1])), links.usable.ravel()
    to_host: dict[int, float | FloatArray] = {}
    for at, flow in enumerate(flows):
        sent = _counts_as(flow, usable, links.cells[here] + near[:, at])
        added[every, near[:, at]] += np.where(is_local[:, at], 0.0, sent)
        received = _counts_as(flow, usable, links.cells[there[at]] + far[:, at])
        to_host[flow.column] = to_host.get(flow.column, 0.0) + received
    arriving = [np.broadcast_to(to_host[flow.column], len(columns)) for flow in flows]
    ends = (
        (here[:, None], near, added[every[:, None], near]),
        (np.array(there, np.int64), far, np.stack(arriving, axis=1)),
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
        chosen(ends[0][2], ends[1][2], 0.0),
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
