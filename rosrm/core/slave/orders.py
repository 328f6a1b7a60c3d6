"""Conversion of the master's orders to events of the slave's core, and refusal of stale ones."""

from __future__ import annotations

from rosrm.core.slave import events
from rosrm.model import orders


def why_stale(order: orders.Order, *, registered: bool) -> str:
    """Return why an order is not for this run of the slave; "" if it is.

    The master may have sent the order before this host reported its instances. Only orders to end
    an instance are safe then.
    """
    if registered or isinstance(order, orders.StopInstance | orders.FenceInstance):
        return ""
    return "this slave is not registered with the master at present; nothing was done"


def event_of(order: orders.InstanceOrder, given_at: float | None = None) -> events.Event:
    """Return the event of an order to the core; the slave's runtime handles all other orders.

    `given_at` is the earliest time of the order, by the slave's clock; None: just now.
    """
    match order:
        case orders.StartInstance(assignment):
            return events.AssignmentsReceived((assignment,), given_at)
        case orders.StopInstance(instance):
            return events.StopOrdered(instance)
        case orders.FenceInstance(instance):
            return events.FenceOrdered(instance)
        case orders.RestartInstance(instance, run):
            return events.RestartOrdered(instance, run)
        case orders.AmendInstance(instance, amendment):
            return events.AmendmentOrdered(instance, amendment)
        case orders.SetLifecycleState(instance, state):
            return events.LifecycleOrdered(instance, state)
        case orders.ReportInstances():
            return events.ReportRequested()
