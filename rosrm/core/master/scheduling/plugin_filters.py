"""Placement filters of plugins: their masks together, and the reason of the first that fails.

A filter that fails passes no host, because a rule that cannot be checked might be broken. The
processes wait then, and the filter is asked again at the next change.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rosrm.core.master.scheduling.candidates import Candidates
from rosrm.core.master.scheduling.host_views import checked_mask, host_view, process_view
from rosrm.core.master.state.host_arrays import BoolArray
from rosrm.errors import PluginError
from rosrm.extensions.placement import SelectedFilter
from rosrm.extensions.plugin_calls import required


def passing_plugins(hosts: Candidates) -> BoolArray | None:
    """Return the mask, (n,), of the hosts that pass the filters of plugins; None: all pass."""
    if not hosts.demand.plugins.filters:
        return None
    masks = [_mask(one, hosts) for one in _asked(hosts)]
    if not masks:
        return None
    passes: BoolArray = np.logical_and.reduce(masks)
    return passes


def why_plugin_excludes(hosts: Candidates, row: int) -> str:
    """Return the reason of the first filter of a plugin that the host of a row fails."""
    for one in _asked(hosts):
        try:
            if not _asked_mask(one, hosts)[row]:
                return f"{_reason(one, hosts, row)} (filter {one.name})"
        except PluginError as error:
            return f"the filter {one.name} failed: {error}"
    return "a filter of a plugin has excluded it, and gives another answer now"


def _asked(hosts: Candidates) -> Iterator[SelectedFilter]:
    """Yield the filters that decide; on empty hosts only those whose refusal is permanent."""
    for one in hosts.demand.plugins.filters:
        if one.permanent or not hosts.empty:
            yield one


def _mask(one: SelectedFilter, hosts: Candidates) -> BoolArray:
    try:
        return _asked_mask(one, hosts)
    except PluginError:
        # A failure is not permanent, so that it sets no process aside.
        return np.full(len(hosts), hosts.empty)


def _asked_mask(one: SelectedFilter, hosts: Candidates) -> BoolArray:
    views = host_view(hosts), process_view(hosts, one.reads)
    return hosts.demand.plugins.calls.ask(
        "filter", one.name, "mask", lambda: checked_mask(one.filter.mask(*views), len(hosts)),
        one.filter,
    )  # fmt: skip


def _reason(one: SelectedFilter, hosts: Candidates, row: int) -> str:
    views = host_view(hosts), process_view(hosts, one.reads)
    return hosts.demand.plugins.calls.ask(
        "filter", one.name, "reason", lambda: required(one.filter.reason(*views, row), str),
        one.filter,
    )  # fmt: skip
