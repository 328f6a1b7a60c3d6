"""Views of hosts for scoring policies, and the check of a policy's scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from rosrm.core.master.scheduling.candidates import Candidates
from rosrm.core.master.state.host_arrays import CAPACITY, LIMIT, BoolArray, FloatArray
from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.extensions.declared_fields import declared_spec
from rosrm.extensions.plugin_calls import given, required

T = TypeVar("T")


def host_view(hosts: Candidates) -> HostView:
    """Return the view of some hosts for a policy."""
    return HostView(
        _Names(hosts), hosts.resources, _read_only(hosts.busy.T),
        _read_only(hosts.cells[LIMIT].T), _read_only(hosts.cells[CAPACITY].T),
        _read_only(hosts.processes[:]), _Labels(hosts), _FreeDevices(hosts),
    )  # fmt: skip


def process_view(hosts: Candidates) -> ProcessView:
    """Return the view of a process for a policy, with its needs on each host."""
    spec = declared_spec(hosts.demand.spec, hosts.demand.reads)
    return ProcessView(spec, _read_only(hosts.need.T))


def _read_only(view: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Make a view of a shared array read-only, because a policy might write into it."""
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
        if isinstance(rows, int):
            return self._of(rows)
        return [self._of(one) for one in rows]

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


class _FreeDevices(_PerHost[Mapping[str, float]]):
    """The free units of each host by kind."""

    def _of(self, row: int) -> Mapping[str, float]:
        hosts = self._hosts
        inventory = hosts.inventories[row]
        if hosts.more is not None:
            inventory = inventory.after(hosts.demand.spec.devices, int(hosts.more[row]))
        return MappingProxyType(inventory.free_by_kind())


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
