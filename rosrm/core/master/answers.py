"""Answers of slaves to orders, each handled by the purpose of its order."""

from __future__ import annotations

from rosrm.core.master import events as happened
from rosrm.core.master import reloading, restarts
from rosrm.core.master.applications import amendments
from rosrm.core.master.checkpoint import images, periodic, replication
from rosrm.core.master.hosts import capabilities, links
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import steps
from rosrm.core.master.state.pending_orders import (
    CapabilityQuery,
    ImageRemoval,
    InstanceAmendment,
    LinkMeasurement,
    MigrationStep,
    PeriodicCheckpoint,
    Reload,
    Replication,
    Restart,
)


def order_answered(state: MasterState, event: happened.OrderAnswered, now: float) -> None:
    """Handle the answer of a slave to an order: accepted, refused, or no answer in time."""
    purpose = state.pending_orders.pop(event.order)
    match purpose:
        case None:
            return
        case MigrationStep(process):
            steps.note_answer(state, process, event, now)
        case InstanceAmendment():
            amendments.note_answer(state, purpose, event, now)
        case Replication(process):
            replication.note_answer(state, process, event)
        case CapabilityQuery():
            capabilities.note_answer(state, purpose, event, now)
        case PeriodicCheckpoint(number):
            periodic.note_answer(state, number, event, now)
        case LinkMeasurement(host):
            links.note_answer(state, host, event, now)
        case Reload(host):
            reloading.note_answer(state, host, event, now)
        case Restart():
            restarts.note_answer(state, purpose, event, now)
        case ImageRemoval(number):
            images.note_answer(state, number, event, now)


def review(state: MasterState, now: float) -> None:
    """Treat each order without any report in time as an order without an answer."""
    for order in state.pending_orders.expired(now):
        order_answered(state, happened.OrderAnswered.missing(order), now)
