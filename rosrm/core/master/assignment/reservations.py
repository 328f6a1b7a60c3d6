"""Reservations (load that the readings do not show yet), and learned needs."""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.process import Instance
from rosrm.model.records import Intent
from rosrm.model.values import InstanceState, InstanceStatus, ProcessSpec

#: Shortest run, in seconds, that shows the CPU use of a program; before, start-up dominates.
_TELLING_RUN: Final = 1.0


def settle_reservation(state: MasterState, instance: Instance, now: float) -> None:
    """Lower the reservation of an instance to the part that the readings do not show yet."""
    table = state.hosts
    instance.settled = now - instance.since >= state.settings.settle
    left = {}
    for resource, amount in instance.demand.items():
        hidden = amount - instance.seen.get(resource, 0.0)
        if hidden > 0.0 and not (instance.settled and resource in instance.estimated):
            left[resource] = hidden
    fractions = table.fractions_of(instance.host, left, instance.estimated)
    reserved = np.where(fractions < np.inf, fractions, 0.0)
    change = reserved.copy()
    change[: len(instance.reserved)] -= instance.reserved
    if np.any(change):
        instance.reserved = reserved
        table.add_reservation(instance.host, change)


def learn_from(
    state: MasterState, spec: ProcessSpec, instance: Instance, status: InstanceStatus
) -> None:
    """Learn the needs of a program from the resources that a run used."""
    if status.state is InstanceState.REFUSED:
        return
    cpu = status.cpu_time / status.run_time if status.run_time >= _TELLING_RUN else 0.0
    peaks = {
        "memory": max(status.peak_memory, instance.peak.get("memory", 0.0)),
        "cpu": max(cpu, instance.peak.get("cpu", 0.0)),
    }
    counts = state.learned.learn(spec.program, peaks)
    if counts is not None:
        state.emit(Intent("learned", spec.program, counts))
