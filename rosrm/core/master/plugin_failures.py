"""Records of plugins that fail or work again, in the master or on a host."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.extensions.plugin_calls import TITLES, Failing, Plugin
from rosrm.model.event_kinds import EventKind
from rosrm.wording import sanitized

#: Maximum number of failing plugins of a host, and of characters of a name or a reason.
_MOST_FAILING: Final = 64
_LONGEST_ERROR: Final = 1000


def note(state: MasterState, now: float) -> None:
    """Record the plugins of the master that began to fail, or to work, since the last call."""
    for (kind, name), error in state.plugins.changes(now):
        event, outcome = (
            (EventKind.PLUGIN_FAILED, f"fails: {error}")
            if error
            else (EventKind.PLUGIN_WORKS, "works again")
        )
        facts = {"plugin": kind, "name": name}
        state.record(now, event, f"the {TITLES[kind]} {name!r} {outcome}", facts=facts)


def note_on_host(state: MasterState, host: Host, failing: Mapping[Plugin, str], now: float) -> None:
    """Note the failing plugins of a host from its slave's report, and record the changes.

    Args:
        failing: every failing plugin to the reason; a probe has the name of its resource.
    """
    failing = {
        (kind, name): sanitized(error, _LONGEST_ERROR)
        for (kind, name), error in islice(failing.items(), _MOST_FAILING)
        if len(name) <= _LONGEST_ERROR
    }
    for plugin in sorted(failing.keys() | host.failing.keys()):
        if plugin not in failing:
            del host.failing[plugin]
            _record_on_host(state, host, plugin, "works again", now)
        elif host.failing.setdefault(plugin, Failing()).note(failing[plugin], 1, now):
            _record_on_host(state, host, plugin, f"fails: {failing[plugin]}", now)


def why_broken(host: Host, strategy: str) -> str:
    """Return why a migration strategy fails on a host, as its slave reports; "": it does not."""
    known = host.failing.get(("migration", strategy))
    return "" if known is None else known.error


def _record_on_host(
    state: MasterState, host: Host, plugin: Plugin, outcome: str, now: float
) -> None:
    kind, name = plugin
    title = f"probe of {name}" if kind == "probe" else f"{TITLES[kind]} {name!r}"
    state.record(
        now, EventKind.PLUGIN_WORKS if outcome == "works again" else EventKind.PLUGIN_FAILED,
        f"the {title} on {host.name} {outcome}", host=host.name,
        facts={"plugin": kind, "name": name},
    )  # fmt: skip
