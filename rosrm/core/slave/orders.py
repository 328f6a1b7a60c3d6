"""Translation of the master's orders to events of the slave's core."""

from __future__ import annotations

from rosrm.core.slave.events import (
    AssignmentsReceived,
    Event,
    FenceOrdered,
    ReportRequested,
    RestartOrdered,
    RestartPolicySet,
    StopOrdered,
)
from rosrm.model.orders import (
    FenceInstance,
    InstanceOrder,
    ReportInstances,
    RestartInstance,
    SetRestartPolicy,
    StartInstance,
    StopInstance,
)


def event_of(order: InstanceOrder, given_at: float | None = None) -> Event:
    """Return the event of an order; all other orders are for the slave's runtime.

    `given_at` is the earliest time of the order, by the slave's clock; None: just now.
    """
    match order:
        case StartInstance(assignment):
            return AssignmentsReceived((assignment,), given_at)
        case StopInstance(instance):
            return StopOrdered(instance)
        case FenceInstance(instance):
            return FenceOrdered(instance)
        case RestartInstance(instance):
            return RestartOrdered(instance)
        case SetRestartPolicy(instance, restart):
            return RestartPolicySet(instance, restart)
        case ReportInstances():
            return ReportRequested()
