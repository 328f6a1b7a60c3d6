"""What becomes of the processes of a host that is lost, and of those that it brings back.

A detached host, whose slave was stopped and left processes running, is as a lost one when its lease
has passed: no process of it may start elsewhere sooner than after a loss.

=========================  ======================================================================
on a lost host             what follows
=========================  ======================================================================
the owner of the name      given up at once, where a standby can take over
                           by `host_loss`: `wait`; after `delay` go `elsewhere`, or `stop`
one that may be the owner  as the owner: the destination of a move that may be active, or the last
                           that is left of a process
one that is cancelled      kept until its host reports it ended, or is pruned; with `elsewhere` and
                           `isolation: stop` given up after `delay`, when its fence has ended it
is being restored          never: its memory is there alone
any other                  given up at once: a former source, a shadow
=========================  ======================================================================

What is given up may still run where nobody hears it; `coming_back` says what becomes of it then.

Nothing is given up while the master hears no host at all, nor for one lease after: then it is
the master that was cut off, and its hosts come back one by one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master import lifecycle
from rosrm.core.master.hosts import readoption
from rosrm.core.master.hosts.fencing import ended_after_loss
from rosrm.core.master.master_state import (
    Instance,
    MasterState,
    Process,
    ProcessPhase,
    Wanted,
)
from rosrm.core.master.migration import failover, handoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import LeftBehind
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim

_OUT_OF_REACH: Final = (HostCondition.LOST, HostCondition.DETACHED)


def lose_sight(state: MasterState, host: Host, now: float) -> None:
    """A host is lost: its processes are out of reach, not gone."""
    host.lost_since = now
    _note_phases(state, host, now)
    _review(state, host, now)


def detach(state: MasterState, host: Host, lease_end: float, now: float) -> None:
    """The slave of a host was stopped and left processes running, which are out of reach now."""
    host.detached_since, host.lost_since = now, lease_end
    _note_phases(state, host, now)


def _note_phases(state: MasterState, host: Host, now: float) -> None:
    for number in host.instances:
        process = state.owned_by(state.instances[number])
        if process is not None and process.name not in state.runs:
            lifecycle.note_phase(state, process, state.instances[number], now)


def regain_sight(state: MasterState, host: Host, now: float) -> None:
    """A lost host is heard again: its processes are again what their instances were last."""
    for number in host.instances:
        instance = state.instances[number]
        process = state.owned_by(instance)
        if process is None or process.name in state.runs:
            continue
        if process.phase is ProcessPhase.UNREACHABLE or process.wanted is Wanted.CANCEL:
            lifecycle.note_phase(state, process, instance, now)
    readoption.take_back_all(state, host, now)


def review_lost_hosts(state: MasterState, now: float) -> None:
    """Give up what is due on every lost or detached host."""
    for column in np.flatnonzero(np.isin(state.hosts.condition, _OUT_OF_REACH)):
        _review(state, state.hosts.hosts[column], now)


def _review(state: MasterState, host: Host, now: float) -> None:
    if now < host.lost_since:
        return
    for number in sorted(host.instances):
        instance = state.instances[number]
        if _is_given_up(state, instance, now):
            _give_up(state, instance, now)


def _is_given_up(state: MasterState, instance: Instance, now: float) -> bool:
    process = state.processes.get(instance.id.process)
    if process is None:
        return True
    if now < state.in_company_since + state.settings.lease:
        return False
    run = state.runs.get(process.name)
    if run is not None and run.aim is Aim.RESTORE and not run.committed:
        return False
    if process.owner not in (0, instance.id.number) and not _may_be_active(state, instance):
        return True
    if process.owner == instance.id.number and failover.is_ready(state, process):
        return True
    policy = process.spec.host_loss
    lost_for = now - instance.host.lost_since
    if process.wanted is Wanted.CANCEL:
        # Its name becomes free now, so it must have ended: only an expired fence ensures that.
        ends_at = max(policy.delay, ended_after_loss(process.spec, state.settings))
        return policy.then == "elsewhere" and lost_for >= ends_at
    return policy.then in ("elsewhere", "stop") and lost_for >= policy.delay


def _may_be_active(state: MasterState, instance: Instance) -> bool:
    """The destination of a move may be the only one that is active, without our knowing."""
    run = state.runs.get(instance.id.process)
    if run is None or run.committed or run.destination != instance.id:
        return False
    number = instance.id.number
    alone = run.plan.overlap == 0.0 and number in run.launched and number not in run.suspended
    return alone or handoff.was_switched(run)


def _give_up(state: MasterState, instance: Instance, now: float) -> None:
    host, process = instance.host, state.processes.get(instance.id.process)
    why = f"{host.name} {state.hosts.why_unreachable(host)}"
    state.record(
        now, EventKind.GIVEN_UP, f"{instance.id} is given up: {why}",
        process=instance.id.process, host=host.name, facts={"number": instance.id.number},
    )  # fmt: skip
    if process is not None and _may_be_taken_back(process, instance):
        process.left_behind = LeftBehind(instance.id.number, host.name, instance.node_name)
    stays = process is not None and process.spec.host_loss.then == "stop"
    lifecycle.gone(state, instance, now, why, comes_again=not stays)


def _may_be_taken_back(process: Process, instance: Instance) -> bool:
    """It owns the name, and nobody has told it to stop."""
    runs_on = process.wanted is Wanted.RUN and not instance.stopping
    return (
        runs_on
        and process.owner == instance.id.number
        and process.spec.host_loss.then == "elsewhere"
    )
