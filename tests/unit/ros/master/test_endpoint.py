"""Events of the master's endpoint, and the readings before them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.state.pending_orders import LinkMeasurement, PendingOrders
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.master.endpoint import MasterEndpoint

REQUEST = happened.ProcessRequested(1, 7, 1)
LEFT = happened.HostLeft(2, 7, 1)
MEASURED = happened.OrderAnswered(PendingOrders().add(LinkMeasurement("h")), accepted=True)
ANSWERED = happened.OrderAnswered(PendingOrders().add(), accepted=True)


@pytest.mark.parametrize(
    ("events", "queued", "polled"),
    [
        ([REQUEST], True, True), ([REQUEST, REQUEST], False, False),
        ([MEASURED], True, True), ([REQUEST, MEASURED], False, False), ([ANSWERED], False, True),
        ([REQUEST, LEFT], False, True), ([LEFT], False, True), ([], True, False),
    ],
)  # fmt: skip
def test_a_decision_uses_the_newest_readings(events, queued, polled) -> None:
    """Without a queued process, requests for work and measurements of links decide nothing.

    The readings then wait for the next tick.
    """
    readings = object()
    endpoint = MasterEndpoint.__new__(MasterEndpoint)
    endpoint._guard = CallbackGuard()
    endpoint._subscriptions = SimpleNamespace(poll_readings=lambda: readings)
    endpoint.events = list(events)
    assert endpoint.take_events(queued=queued) == ([readings] if polled else []) + events
    assert endpoint.events == []
