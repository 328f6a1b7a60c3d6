"""Reservations (load that the readings do not show yet), and learned needs."""

from __future__ import annotations

from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import Instance
from rosrm.model.records import Intent
from rosrm.model.values import InstanceState, InstanceStatus, is_plausible

#: Shortest run, in seconds, that shows the use of a program; before, start-up dominates.
_TELLING_RUN: Final = 1.0


def review_reservation(state: MasterState, instance: Instance, now: float) -> None:
    """Settle the reservation of an instance if a part of it has ended, or counts again."""
    settle = state.settings.settle
    settles = not instance.settled and now - instance.since >= settle
    if settles or instance.shown is not _is_shown(instance, now, settle):
        settle_reservation(state, instance, now)


def settle_reservation(state: MasterState, instance: Instance, now: float) -> None:
    """Lower the reservation of an instance to the part that the readings do not show yet."""
    instance.settled = instance.settled or now - instance.since >= state.settings.settle
    instance.shown = _is_shown(instance, now, state.settings.settle)
    state.reserve_rest(instance)


def _is_shown(instance: Instance, now: float, settle: float) -> bool:
    """Return True if the readings show the load of an instance: it is ready for `settle`."""
    return instance.state is InstanceState.READY and now - instance.ready_at >= settle


def learn_from(state: MasterState, instance: Instance, status: InstanceStatus) -> None:
    """Learn the needs of a program from the resources that a run used.

    A run that was too short or has failed may not have got far: it raises the needs, and never
    lowers them.
    """
    if status.state is InstanceState.REFUSED:
        return
    is_telling = status.run_time >= _TELLING_RUN
    cpu = status.cpu_time / status.run_time if is_telling else 0.0
    peaks = instance.peak | {
        "memory": max(status.peak_memory, instance.peak.get("memory", 0.0)),
        "cpu": max(cpu, instance.peak.get("cpu", 0.0)),
    }
    plausible = {name: used for name, used in peaks.items() if is_plausible(name, used)}
    may_lower = is_telling and not _has_failed(status)
    changed = state.learned.learn(instance.spec.program, plausible, may_lower=may_lower)
    for program, counts in changed.items():
        state.emit(Intent("learned", program, counts and dict(counts)))


def _has_failed(status: InstanceStatus) -> bool:
    return status.state is InstanceState.FAILED or bool(status.exit_code)
