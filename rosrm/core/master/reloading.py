"""Reload: the settings of the master and of its slaves are read again from their files.

A file is checked as a whole, and changes nothing if it is not valid. The file of the master comes
first: if it is refused, no slave reads its own.
"""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.core.master.commands import ReadSettings, Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.modes.settings import apply_settings
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.pending_orders import Reload
from rosrm.core.master.state.reloads import Reloads
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import ReloadSettings
from rosrm.wording import reload_summary


def reload_requested(state: MasterState, event: happened.ReloadRequested, now: float) -> None:
    """Let the file of the master be read."""
    if state.reloads.request:
        raise RequestRefused("the settings are being reloaded already")
    state.reloads = Reloads(event.request)
    state.emit(ReadSettings(event.request))


def settings_read(state: MasterState, event: happened.SettingsRead, now: float) -> None:
    """Apply the settings of the master, and order the slaves to read theirs."""
    if event.fault:
        message = f"the settings of the master are not reloaded: {event.fault}"
        state.record(now, EventKind.RELOAD_REFUSED, message)
        if event.request:
            state.reloads = Reloads()
            what = "Nothing was changed, and no slave has read its file"
            state.emit(Reply(event.request, False, "invalid", f"{event.fault}\n{what}"))
        return
    if event.settings is not None:
        _apply(state, event)
    line = f"the master: {reload_summary(event.changed, event.kept)}"
    if event.changed or event.kept:
        state.record(now, EventKind.SETTINGS_RELOADED, line)
    if event.request:
        state.reloads.lines.append(line)
        _order_slaves(state)


def _apply(state: MasterState, event: happened.SettingsRead) -> None:
    assert event.settings is not None
    state.settings = event.settings
    if "scoring" in event.changed:
        state.scoring = event.scoring
        apply_settings(state)
    for process in state.processes.values():
        process.demand = None  # needs and defaults may have changed
    state.hosts.changed()


def _order_slaves(state: MasterState) -> None:
    for host in state.hosts.listed():
        if state.hosts.condition_of(host) is HostCondition.UP:
            state.reloads.awaited.add(host.name)
            state.send(host, ReloadSettings(), Reload(host.name))
        else:
            state.reloads.lines.append(f"{host.name}: not reloaded: its slave does not report")
    _reply_if_complete(state)


def note_answer(state: MasterState, host: str, event: happened.OrderAnswered, now: float) -> None:
    """Note the answer of a slave; the last one completes the reply."""
    if host not in state.reloads.awaited:
        return
    state.reloads.awaited.remove(host)
    kind = EventKind.SETTINGS_RELOADED if event.accepted else EventKind.RELOAD_REFUSED
    what = event.message if event.accepted else f"not reloaded: {event.reason}"
    state.record(now, kind, f"{host}: {what}", host=host)
    state.reloads.lines.append(f"{host}: {what}")
    state.reloads.refused |= not event.accepted
    _reply_if_complete(state)


def _reply_if_complete(state: MasterState) -> None:
    done = state.reloads
    if done.awaited:
        return
    state.reloads = Reloads()
    message = "\n".join(done.lines)
    if done.refused:
        state.emit(Reply(done.request, False, "invalid", message))
    else:
        state.emit(Reply(done.request, message=message))
