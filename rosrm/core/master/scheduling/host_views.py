"""Views of hosts for scoring policies and filters, and the checks of their answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar
from weakref import proxy

import numpy as np
import numpy.typing as npt

from rosrm.core.master.scheduling.candidates import Candidates
from rosrm.core.master.scheduling.traffic import rates, round_trips
from rosrm.core.master.state.host_arrays import CAPACITY, LIMIT, BoolArray, FloatArray, IntArray
from rosrm.core.master.state.links import LinkTable
from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.extensions.declared_fields import FLOWS_FIELD, SPEC_FIELDS, declared_spec
from rosrm.extensions.link_views import no_flows
from rosrm.extensions.plugin_calls import given, required
from rosrm.model.values import ProcessSpec

T = TypeVar("T")


def host_view(hosts: Candidates) -> HostView:
    """Return the view of some hosts for a plugin, the same one for all plugins.

    It does not keep the hosts. A cycle in each of the thousands of decisions that a master keeps
    would be freed only by a full collection of garbage, which is rare.
    """
    if hosts.view is None:
        weak = proxy(hosts)
        hosts.view = _View(
            _Names(weak), hosts.resources, _read_only(hosts.busy.T),
            _read_only(hosts.cells[LIMIT].T), _read_only(hosts.cells[CAPACITY].T),
            _read_only(hosts.processes[:]), _Labels(weak), _Links(weak), _Tenants(weak),
            _FreeDevices(weak),
        )  # fmt: skip
    return hosts.view


class _View(HostView):
    """A view whose masks of labels come from the cache of the table."""

    def labelled(self, key: str, value: str) -> BoolArray:
        """Return the mask, (N,), of the hosts with a label of this value, as a new array."""
        assert isinstance(self.labels, _Labels)
        return self.labels.mask(key, value)


def process_view(hosts: Candidates, reads: tuple[str, ...]) -> ProcessView:
    """Return the view of a process with its needs on each host.

    `reads`: fields of the spec that the offer of the plugin declares.
    """
    known = hosts.process_views.get(reads)
    if known is not None:
        return known
    has_flows = FLOWS_FIELD in reads and hosts.demand.traffic.flows
    flows = hosts.flows() if has_flows else no_flows()
    spec = declared_spec(hosts.demand.spec, reads)
    view = ProcessView(spec, _read_only(hosts.need.T), flows)
    if not has_flows:  # round trips and rates of flows change with the links, so keep no such view
        hosts.process_views[reads] = view
    return view


def _read_only(view: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Make a view of a shared array read-only, because a plugin might write into it."""
    view.flags.writeable = False
    return view


class _PerHost(Sequence[T]):
    """A lazy sequence over hosts, because building a thousand items per decision costs too much."""

    def __init__(self, hosts: Candidates) -> None:
        self._hosts = hosts

    def __len__(self) -> int:
        return len(self._hosts)

    def __getitem__(self, row: Any) -> Any:
        rows = range(len(self._hosts))[row]
        return self._of(rows) if isinstance(rows, int) else [self._of(one) for one in rows]

    def _of(self, row: int) -> T:
        raise NotImplementedError


class _Names(_PerHost[str]):
    """The name of each host."""

    def _of(self, row: int) -> str:
        return self._hosts.host(row).name


class _Labels(_PerHost[Mapping[str, str]]):
    """The labels of each host."""

    def _of(self, row: int) -> Mapping[str, str]:
        return MappingProxyType(dict(self._hosts.host(row).description.labels))

    def mask(self, key: str, value: str) -> BoolArray:
        """Return the mask, (n,), of the hosts with a label of this value, as a new array."""
        return np.array(self._hosts.table.labelled(key, value)[self._hosts.columns])


class _Tenants(_PerHost[Mapping[str, ProcessSpec]]):
    """The processes of each host; notes that a plugin has read them."""

    def _of(self, row: int) -> Mapping[str, ProcessSpec]:
        self._hosts.tenants_read = True
        tenants = self._hosts.tenants_of(row).items()
        return MappingProxyType({name: declared_spec(spec, SPEC_FIELDS) for name, spec in tenants})


class _FreeDevices(_PerHost[Mapping[str, float]]):
    """The free units of each host by kind."""

    def _of(self, row: int) -> Mapping[str, float]:
        hosts = self._hosts
        inventory = hosts.inventories[row]
        if hosts.more is not None:
            inventory = inventory.after(hosts.demand.spec.devices, int(hosts.more[row]))
        return MappingProxyType(inventory.free_by_kind())


def checked_mask(mask: object, count: int) -> BoolArray:
    """Return the mask of a filter; raise PluginError if it breaks the contract."""
    found = np.asarray(mask)
    if found.dtype != np.bool_:
        shown = given(mask) if found.dtype == np.object_ else f"a mask of type {found.dtype}"
        raise PluginError(f"answered {shown}; booleans are required, True: the host may be chosen")
    if found.shape != (count,):
        raise PluginError(f"a mask of shape {found.shape} for {count} hosts")
    return found


class _Links:
    """`LinkView` of some hosts; computed when it is read, because few policies read it."""

    def __init__(self, hosts: Candidates) -> None:
        self._hosts = hosts

    @property
    def hosts(self) -> Sequence[str]:
        return [host.name for host in self._hosts.table.hosts]

    @property
    def round_trip(self) -> FloatArray:
        return self._read(round_trips, 0.0)

    @property
    def rate(self) -> FloatArray:
        return self._read(rates, np.inf)

    def _read(
        self, values: Callable[[LinkTable, IntArray, IntArray], FloatArray], own: float
    ) -> FloatArray:
        every, at = np.arange(len(self._hosts.table)), self._hosts.columns
        columns = every[at] if isinstance(at, slice) else at
        found = values(self._hosts.table.links, columns, every)
        found[columns[:, None] == every] = own
        return _read_only(found)


def checked_scores(
    scores: Scores, hosts: HostView, fits: BoolArray
) -> tuple[FloatArray, BoolArray | None]:
    """Return value and veto of a policy's answer; raise PluginError if it breaks the contract."""
    size = len(fits)
    required(scores, Scores)
    try:
        value = np.asarray(scores.value, np.float64)
    except (TypeError, ValueError):
        raise PluginError(
            f"answered scores that are no numbers: {given(scores.value)}; {size} numbers are "
            f"required, one for each host"
        ) from None
    if value.shape != (size,):
        raise PluginError(f"scores of shape {value.shape} for {size} hosts")
    veto = None
    asked = fits
    if scores.veto is not None:
        veto = np.asarray(scores.veto)
        if veto.shape != (size,):
            raise PluginError(f"vetoes of shape {veto.shape} for {size} hosts")
        if veto.dtype != np.bool_:
            raise PluginError(f"vetoes of type {veto.dtype}; booleans are required, True: vetoed")
        asked = fits & ~veto
    if np.count_nonzero(np.isfinite(value)) < size:
        wrong = np.flatnonzero(asked & ~np.isfinite(value))
        if len(wrong):
            row = int(wrong[0])
            raise PluginError(
                f"the score of host {hosts.names[row]} is {value[row]}{_unread_by(hosts, row)}"
            )
    return value, veto


def _unread_by(hosts: HostView, row: int) -> str:
    """Return a sentence on the resources that a host does not measure (a cause of NaN), or ""."""
    names = [
        name for name, usage in zip(hosts.resources, hosts.usage[row], strict=True)
        if np.isnan(usage)
    ]  # fmt: skip
    if not names:
        return ""
    return (
        f". It does not measure {', '.join(names)}, so `usage` and `capacity` are NaN there; "
        "`column` is not"
    )
