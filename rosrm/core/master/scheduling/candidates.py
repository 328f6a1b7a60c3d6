"""Candidates: some hosts and one demand, the input of placement filters and scoring policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rosrm.core.master.scheduling.traffic import flow_view
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.devices import Inventory
from rosrm.core.master.state.host_arrays import BUSY, FloatArray, IntArray
from rosrm.core.master.state.hosts import Host, HostTable
from rosrm.extensions.contracts import HostView, ProcessView
from rosrm.extensions.link_views import FlowView
from rosrm.model.values import EMPTY, ProcessSpec

Columns = slice | IntArray


class _Referable:
    """Base of a class with slots to which weak references are possible."""

    __slots__ = ("__weakref__",)


@dataclass(slots=True)  # not frozen, because each of thousands would take 1 µs more to create
class Candidates(_Referable):
    """Some hosts, n of them, with one demand.

    The arrays have all that assignments change. They are copies if `columns` is an array.

    Attributes:
        columns: columns of the hosts in the table; a host never changes its column.
        resources: names of the R rows.
        need: (R, n) fractions of the capacity of each host; inf where it lacks the resource.
        cells: (planes, R, n) as in `HostColumns`.
        busy: (R, n) reading plus reservations.
        processes: (n,) number of processes on the host or reserved for it.
        bound: (n,) highest number of processes.
        inventories: (n,) devices of each host.
        sets: (n,) number of further processes of this demand for which the host has devices; at
            most COUNTED.
        more: (n,) number of processes of this demand that were added to each host; None: none.
        known_flows: flows of the process on each host; None: not computed yet.
        empty: True if the arrays are those of hosts without processes.
        tenants: (n,) name to spec of each process on the host; None: as the table has them now.
        tenants_read: True if a plugin has read which processes run on one of the hosts.
        view: of the hosts for plugins; None: not made yet.
        process_views: view of the process, by the fields that a plugin reads. A view with flows is
            not stored.
    """

    table: HostTable
    demand: Demand
    columns: Columns
    resources: tuple[str, ...]
    need: FloatArray
    cells: FloatArray
    busy: FloatArray
    processes: IntArray
    bound: IntArray
    inventories: Sequence[Inventory]
    sets: IntArray | None = None
    more: IntArray | None = None
    known_flows: FlowView | None = None
    empty: bool = False
    tenants: tuple[Mapping[str, ProcessSpec], ...] | None = None
    tenants_read: bool = False
    view: HostView | None = None
    process_views: dict[tuple[str, ...], ProcessView] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.processes)

    def tenants_of(self, row: int) -> Mapping[str, ProcessSpec]:
        """Return name to spec of each process with an instance on the host of a row."""
        if self.tenants is not None:
            return self.tenants[row]
        if self.empty:
            return EMPTY
        return dict(self.host(row).instances.values())

    def keep_tenants(self) -> None:
        """Copy the current processes of each host, because they change before they are read."""
        self.tenants = tuple(map(self.tenants_of, range(len(self))))

    def flows(self) -> FlowView:
        """Return the flows of the process on each host."""
        if self.known_flows is None:
            at, table = self.columns, self.table
            columns = np.arange(len(table))[at] if isinstance(at, slice) else at
            traffic = self.demand.traffic
            self.known_flows = flow_view(table.links, traffic, columns, empty=self.empty)
        return self.known_flows

    def host(self, row: int) -> Host:
        """Return the host of a row."""
        columns = self.columns
        at = columns.start + row if isinstance(columns, slice) else int(columns[row])
        return self.table.hosts[at]


def candidates(
    table: HostTable, demand: Demand, need: FloatArray, columns: Columns,
    more: IntArray | None = None,
) -> Candidates:  # fmt: skip
    """Return some hosts in their current condition, with a demand.

    Args:
        need: (R, H) fractions, of every host.
        more: (n,) number of processes of this demand to add to each host.
    """
    need = need[:, columns]
    cells = table.cells[:, :, columns]  # all planes at once: one copy costs less than five
    busy, processes = cells[BUSY], table.processes[columns]
    if more is not None:
        busy, processes = busy + need * more, processes + more
    hosts = Candidates(
        table=table, demand=demand, columns=columns, resources=table.resources, need=need,
        cells=cells, busy=busy, processes=processes, bound=table.bound[columns],
        inventories=table.devices.at(columns), more=more,
    )  # fmt: skip
    if demand.spec.devices:
        sets = table.devices.counts(demand.spec.devices)[columns]
        hosts.sets = sets if more is None else sets - more
    return hosts


def as_if_empty(table: HostTable, demand: Demand, columns: Columns) -> Candidates:
    """Return some hosts as if no process ran on them, with a demand."""
    need = table.fractions(demand.amounts, demand.estimated)
    hosts = candidates(table, demand, need, columns)
    hosts.busy, hosts.processes = np.zeros_like(hosts.busy), np.zeros_like(hosts.processes)
    hosts.empty = True
    if demand.spec.devices:
        hosts.sets = table.devices.counts(demand.spec.devices, empty=True)[columns]
    return hosts
