"""Modes: sets of applications of which one is in force; a switch is one request on applications.

==========================  =====================================================================
state                       event and effect
==========================  =====================================================================
in force, or none           a request, or a condition that begins to hold: the applications of the
                            new mode are desired, and those that only the old one has are cancelled
in force, or none           the plan shows that a process would find no host: nothing changes
switching                   all applications are as desired: the new mode is in force
switching                   a process fails: the switch returns to the old mode, if there is one
==========================  =====================================================================

Limits and weights of a mode apply from the begin of the switch to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import inf
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.applications import requests as applications
from rosrm.core.master.applications.deadlines import has_waited_too_long
from rosrm.core.master.commands import Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.modes.settings import apply_settings, weighted
from rosrm.core.master.outcomes import RequestRefused
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.modes import Modes
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.errors import RosrmError
from rosrm.model.applications import PlannedAction, Target
from rosrm.model.event_kinds import EventKind
from rosrm.model.modes import Mode, ModeRow, Trigger
from rosrm.model.requester import OPERATOR, Requester
from rosrm.wording import counted, few, listed, no_such

#: First and longest time, in seconds, until a mode whose condition holds is tried again.
_WAITS: Final = (2.0, 60.0)


# --- requests ---------------------------------------------------------------------------------


def modes_loaded(state: MasterState, event: happened.ModesLoaded, now: float) -> None:
    """Replace all modes, or refuse them; the applications stay as they are."""
    former, known = state.modes, {mode.name: mode for mode in event.modes}
    if len(known) < len(event.modes):
        raise RequestRefused("the name of a mode is given twice. Nothing was changed")
    for mode in event.modes:
        _check_weights(state, mode)
    if former.wanted and former.wanted not in known:
        raise RequestRefused(
            f"the mode {former.wanted} is in force, and the file does not have it: keep it there, "
            f"or switch to another one first. Nothing was changed"
        )
    for name in former.known.keys() - known.keys():
        state.save_mode(name, None)
    for mode in event.modes:
        state.save_mode(mode.name, mode)
    fault = {name: why for name, why in former.fault.items() if name in known}
    met = [mode.name for mode in event.modes if mode.name in former.met]
    state.modes = replace(former, known=known, loaded_by=event.by, fault=fault, met=met)
    apply_settings(state)
    state.save_modes()
    message = f"{counted(len(known), 'mode')} loaded: {listed(known)}"
    state.record(now, EventKind.MODES_LOADED, message, by=event.by)
    state.emit(Reply(event.request, message=message))


def mode_requested(state: MasterState, event: happened.ModeRequested, now: float) -> None:
    """Switch to a mode, or reply with the plan of that."""
    mode = state.modes.known.get(event.mode)
    if mode is None:
        known = no_such("mode", [event.mode], state.modes.known)
        raise RequestRefused(known, "unknown")
    targets = _targets(state, mode)
    outlook = applications.outlook(state, targets, event.by, now)
    obstacles = "; ".join(few(outlook.obstacles))
    if event.plan_only:
        warning = f"; {mode.name} cannot be reached: {obstacles}" if obstacles else ""
        message = f"{outlook.message}{warning}"
        state.emit(Reply(event.request, message=message, actions=outlook.actions))
        return
    if obstacles:
        raise RequestRefused(
            f"the mode {mode.name} cannot be reached: {obstacles}. {_stays(state.modes)}"
        )
    message, actions = _switch(state, mode, "on request", event.by, now)
    state.emit(Reply(event.request, message=message, actions=actions))


def _stays(modes: Modes) -> str:
    return f"{modes.wanted} stays in force" if modes.wanted else "Nothing was changed"


def _targets(state: MasterState, mode: Mode) -> tuple[Target, ...]:
    """Return the desired state of all applications of a mode and of the one in force."""
    before = state.modes.mode
    leaving = before.applications if before is not None else ()
    gone = [
        name for name in leaving
        if name not in mode.applications and name in state.applications
    ]  # fmt: skip
    return (*mode.targets, *map(Target, gone))


def _check_weights(state: MasterState, mode: Mode) -> None:
    """Refuse weights that no scoring policy takes."""
    if not mode.weights or state.chain_of is None:
        return
    try:
        state.chain_of(weighted(state, mode))
    except RosrmError as fault:
        raise RequestRefused(f"mode {mode.name}: weights: {fault}. Nothing was changed") from None
    if not any("weights" in one.options for one in state.scoring):
        names = listed(one.name for one in state.scoring)
        raise RequestRefused(
            f"mode {mode.name}: weights: no selected scoring policy has weights (selected: "
            f"{names}). Nothing was changed"
        )


# --- the switch -------------------------------------------------------------------------------


def _switch(
    state: MasterState, mode: Mode, cause: str, by: Requester, now: float, *, returns: bool = False
) -> tuple[str, tuple[PlannedAction, ...]]:
    """Make the applications of a mode desired; return the summary and the actions.

    Args:
        cause: phrase for the record.
        returns: the switch to another mode has failed.
    """
    modes, targets = state.modes, _targets(state, mode)
    message, actions = applications.execute(state, targets, by, now)
    modes.wanted, modes.switching, modes.began = mode.name, True, now
    modes.met += [name for name in modes.retries if name in modes.known]
    modes.retries.clear()
    names = [target.application for target in targets]
    found = {name: state.applications.get(name) for name in names}
    # A cancelled one may have been removed, to make room for the specs of another.
    modes.versions = {name: one.wanted for name, one in found.items() if one is not None}
    if not returns:
        modes.fault.pop(mode.name, None)
    apply_settings(state)
    state.save_modes()
    text = f"the cluster switches to the mode {mode.name}: {cause}"
    state.record(now, EventKind.MODE_BEGINS, text, facts={"mode": mode.name}, by=by)
    return message, actions


# --- the review -------------------------------------------------------------------------------


def review(state: MasterState, now: float) -> None:
    """Note the end of a switch, and switch where a condition begins to hold."""
    if state.modes.switching:
        _review_switch(state, now)
    for mode in list(state.modes.known.values()):
        _review_trigger(state, mode, now)


def _review_switch(state: MasterState, now: float) -> None:
    modes, mode = state.modes, state.modes.mode
    assert mode is not None
    fault = next(_faults(state, mode, now), "")
    if fault:
        _handle_fault(state, mode, fault, now)
    elif not any(one.tasks for name in modes.versions if (one := state.applications.get(name))):
        modes.switching, modes.reached = False, mode.name
        state.save_modes()
        text = f"the mode {mode.name} is in force"
        state.record(now, EventKind.MODE_REACHED, text, facts={"mode": mode.name})


def _faults(state: MasterState, mode: Mode, now: float) -> Iterator[str]:
    """Yield why a mode cannot be reached; nothing: it still may."""
    for name in mode.applications:
        application = state.applications.get(name)
        number = state.modes.versions.get(name)
        if number is None:
            continue  # the modes were loaded since the switch began
        if application is None or application.wanted != number:
            version = application.versions.get(number) if application is not None else None
            yield version.given_up if version and version.given_up else f"{name} was changed since"
            continue
        if application.paused:
            yield f"{name} is paused: {application.paused}"
        for process, task in application.tasks.items():
            known = state.processes.get(process)
            if known is not None and known.phase is ProcessPhase.SET_ASIDE:
                yield f"{process} is set aside: {known.reason or task.reason}"
        # A process out of reach is no fault: its host may return, as after a restart of the master.
        for process in application.specs if not application.tasks else ():
            known = state.processes.get(process)
            if known is not None and known.phase is ProcessPhase.FAILED:
                yield f"{process} has failed: {known.reason}"
            elif known is not None and _crashes(state, known):
                yield f"{process} does not run well: {known.reason}"
            elif known is not None and has_waited_too_long(state, known, state.modes.began, now):
                yield f"{process} finds no host: {known.reason}"


def _crashes(state: MasterState, process: Process) -> bool:
    """Return True if a process that the switch has started is in back-off.

    The first version of an application has none to return to, so its work ends with the crash. A
    restarted master does not know which processes the switch has started.
    """
    is_new = -inf < state.modes.began <= process.started_at
    return is_new and process.phase is ProcessPhase.BACKOFF


def _handle_fault(state: MasterState, mode: Mode, fault: str, now: float) -> None:
    """Return to the former mode; without one, end the switch."""
    modes = state.modes
    modes.fault[mode.name] = fault
    former = modes.known.get(modes.reached) if modes.reached != mode.name else None
    facts = {"mode": mode.name}
    if former is None:
        modes.switching = False
        state.save_modes()
        text = f"the mode {mode.name} is not reached: {fault}"
        state.record(now, EventKind.MODE_FAILED, text, facts=facts)
        return
    text = f"the mode {mode.name} is not reached, and {former.name} returns: {fault}"
    state.record(now, EventKind.MODE_FAILED, text, facts=facts)
    try:
        _switch(state, former, "the other is not reached", OPERATOR, now, returns=True)
    except RequestRefused as refusal:
        modes.switching = False
        state.save_modes()
        text = f"the mode {former.name} does not return: {refusal}"
        state.record(now, EventKind.MODE_FAILED, text, facts={"mode": former.name})


def _review_trigger(state: MasterState, mode: Mode, now: float) -> None:
    """Switch to a mode whose condition begins to hold; try again while it cannot be reached."""
    modes = state.modes
    holds = _holds(state, mode.when, now)
    if not holds:
        modes.retries.pop(mode.name, None)
    if holds is None or holds == (mode.name in modes.met):
        return
    if not holds:
        modes.met.remove(mode.name)
        state.save_modes()
        return
    if mode.name == modes.wanted:
        modes.met.append(mode.name)
        state.save_modes()
        return
    backoff = modes.retries.setdefault(mode.name, Backoff())
    if now < backoff.until:
        return
    by = Requester(modes.loaded_by.name, is_operator=True)
    try:
        outlook = applications.outlook(state, _targets(state, mode), by, now)
        fault = "; ".join(few(outlook.obstacles))
        if not fault:
            _switch(state, mode, f"{mode.when}", by, now)
            return
    except RequestRefused as refusal:
        fault = str(refusal)
    backoff.note(now, *_WAITS)
    if backoff.tries > 1:
        return
    modes.fault[mode.name] = fault
    state.save_modes()
    text = f"{mode.when}, but the mode {mode.name} cannot be reached: {fault}"
    state.record(now, EventKind.MODE_FAILED, text, facts={"mode": mode.name})


def _holds(state: MasterState, when: Trigger, now: float) -> bool | None:
    """Return True if a condition holds; None: that is not known, or there is no condition."""
    if when.host_lost:
        host = state.hosts.by_name.get(when.host_lost)
        condition = None if host is None else state.hosts.condition_of(host)
        known = (HostCondition.LOST, HostCondition.UP)
        return condition is HostCondition.LOST if condition in known else None
    if when.over_limit:
        hosts = state.hosts.listed()
        since = min((host.exceeded_since.get(when.over_limit, inf) for host in hosts), default=inf)
        if now - since >= when.lasts:
            return True
        # A new master does not know for how long a host has been over its limit.
        return None if since < inf or any(_is_unread(state, host) for host in hosts) else False
    return None


def _is_unread(state: MasterState, host: Host) -> bool:
    """Return True if a host may be over a limit, but has not reported since this master started."""
    condition = state.hosts.condition_of(host)
    unread = condition is HostCondition.UP and bool(state.hosts.without_reading()[host.column])
    return unread or condition is HostCondition.EXPECTED


# --- listing ----------------------------------------------------------------------------------


def mode_rows(state: MasterState) -> Sequence[ModeRow]:
    """Return every mode, in the order of the file."""
    modes = state.modes
    in_force = "switching" if modes.switching else "in force"
    return [
        ModeRow(
            mode.name, in_force if mode.name == modes.wanted else "", mode.applications,
            mode.limits, mode.weights, str(mode.when), _why(state, mode), mode.digest,
        )
        for mode in modes.known.values()
    ]  # fmt: skip


def _why(state: MasterState, mode: Mode) -> str:
    """Return why a mode was left or not reached, or what has changed since it came into force."""
    modes = state.modes
    if mode.name != modes.wanted or modes.switching or mode.name in modes.fault:
        return modes.fault.get(mode.name, "")
    changes = [
        f"{name} was {'changed' if version else 'cancelled'} since"
        for name in mode.applications
        if (version := _version_of(state, name)) != modes.versions.get(name)
    ]
    again = f"; `rosrm mode {mode.name}` applies the mode again"
    return f"{listed(changes)}{again}" if changes else ""


def _version_of(state: MasterState, name: str) -> int:
    """Return the number of the desired version of an application; 0: there is none."""
    application = state.applications.get(name)
    return 0 if application is None else application.wanted
