"""Load that the flows of a process would put on the links of hosts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rosrm.core.master.state.demand import Flow, Traffic
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray, IntArray
from rosrm.core.master.state.links import LinkTable
from rosrm.extensions.link_views import FlowView

#: A learned flow counts as at most this share of what flows may use of a link. Otherwise two nodes
#: that exchange more in the memory of one host could never leave it.
_MOST_LEARNED: Final = 0.5


def keeping_limits(
    links: LinkTable, traffic: Traffic, hosts: int, *, empty: bool = False
) -> BoolArray | None:
    """Return the mask, (H,), of hosts whose links stay within their limits; None: all of them do.

    Args:
        hosts: number of hosts.
        empty: True: as if nothing but the process used the links.
    """
    if not traffic.flows or not links.size:
        return None
    doubtful = np.arange(min(hosts, links.size))
    if not empty:
        total = sum(flow.rate for flow in traffic.flows)
        others = [links.row(flow.column) for flow in traffic.flows]
        if links.least_room[others].min() >= total:  # so only the host itself may lack room
            doubtful = np.flatnonzero(links.least_room[: len(doubtful)] < total)
    if not len(doubtful):
        return None
    kept = np.ones(hosts, np.bool_)
    kept[doubtful] = ~flow_view(links, traffic, doubtful, empty=empty).is_over().any(axis=1)
    return kept


def flow_view(
    links: LinkTable, traffic: Traffic, columns: IntArray, *, empty: bool = False
) -> FlowView:
    """Return the flows of a process on each of N hosts, given by their columns.

    Args:
        empty: True: as if nothing but the process used the links.
    """
    flows, here = traffic.flows, np.minimum(columns, links.size)
    load = np.zeros_like(links.load) if empty else links.load_without(traffic.counted)
    room = links.room if load is links.load else links.usable - load
    others = [links.row(flow.column) for flow in flows]
    is_local = np.array([[flow.column] for flow in flows], np.int64) == columns
    first = links.cells.take(here)
    near = [first + links.facing[other].take(here) for other in others]
    far = [links.cells[other] + links.interface[other].take(here) for other in others]
    sent = _sent(links, flows, near, ~is_local)
    received = _received(links, flows, far)
    # Arrays of (F, N), because one flow after the other is faster than all at once.
    rate, limit, used, added, round_trip = np.empty((5, *is_local.shape))
    for row, other in enumerate(others):
        is_near = room.take(near[row]) - sent[row] <= room.take(far[row]) - received[row]
        cells = np.where(is_near, near[row], far[row])
        rate[row], limit[row] = links.rate.take(cells), links.allowed.take(cells)
        used[row], added[row] = load.take(cells), np.where(is_near, sent[row], received[row])
        round_trip[row] = links.round_trip[other].take(here)
    rate[is_local] = limit[is_local] = np.inf
    used[is_local] = added[is_local] = round_trip[is_local] = 0.0
    by_host = (_by_host(one) for one in (is_local, rate, limit, used, added, round_trip))
    return FlowView(
        tuple(flow.process for flow in flows), tuple(flow.host for flow in flows),
        np.array([flow.rate for flow in flows]),
        np.array([flow.incoming for flow in flows], np.bool_), *by_host,
    )  # fmt: skip


def rows_of(view: FlowView, rows: slice | IntArray) -> FlowView:
    """Return the flows on some of the hosts of a view."""
    return replace(
        view, is_local=view.is_local[rows], link_rate=view.link_rate[rows],
        link_limit=view.link_limit[rows], link_load=view.link_load[rows], added=view.added[rows],
        round_trip=view.round_trip[rows],
    )  # fmt: skip


def _sent(
    links: LinkTable, flows: Sequence[Flow], near: Sequence[IntArray], counts: BoolArray
) -> list[FloatArray]:
    """Return the sum of the flows that would cross the interface of each flow, (N,), at the host.

    Args:
        near: (N,) cells of the interfaces, for each flow.
        counts: (F, N) False: the flow is local.
    """
    interfaces = links.load.shape[1]
    rows = np.arange(counts.shape[1]) * interfaces
    cells = [rows + one % interfaces for one in near]
    total = np.zeros(counts.shape[1] * interfaces)
    for row, flow in enumerate(flows):
        total[cells[row]] += counts[row] * _counts_as(links, flow, near[row])
    return [total.take(one) for one in cells]


def _received(
    links: LinkTable, flows: Sequence[Flow], far: Sequence[IntArray]
) -> list[float | FloatArray]:
    """Return the sum of the flows that arrive at the host of each flow's other process, (N,)."""
    total: dict[int, float | FloatArray] = {}
    for flow, cells in zip(flows, far, strict=True):
        total[flow.column] = total.get(flow.column, 0.0) + _counts_as(links, flow, cells)
    return [total[flow.column] for flow in flows]


def _counts_as(links: LinkTable, flow: Flow, cells: IntArray) -> float | FloatArray:
    """Return the bytes a second as which a flow counts on interfaces, given by their cells."""
    if not flow.learned:
        return flow.rate
    return np.minimum(flow.rate, _MOST_LEARNED * links.usable.take(cells))


def _by_host(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values of (F, N) as a read-only view of (N, F)."""
    found: npt.NDArray[Any] = values.T
    found.flags.writeable = False
    return found


def round_trips(links: LinkTable, columns: IntArray, peers: IntArray) -> FloatArray:
    """Return the seconds of a round trip, (N, P), between hosts; NaN: not measured."""
    here, there = (np.minimum(one, links.size) for one in (columns, peers))
    return links.round_trip[here[:, None], there].astype(np.float64)


def rates(links: LinkTable, columns: IntArray, peers: IntArray) -> FloatArray:
    """Return the bytes a second, (N, P), that the links between hosts can carry; NaN: not known."""
    here, there = np.minimum(columns, links.size)[:, None], np.minimum(peers, links.size)
    near = links.rate[here, links.interface[here, there]]
    return np.fmin(near, links.rate[there, links.interface[there, here]])
