"""Events of the master's endpoint, and the readings before them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.core.master import events as happened
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.master.endpoint import MasterEndpoint

REQUEST = happened.ProcessRequested(1, 7, 1)
LEFT = happened.HostLeft(2, 7, 1)


@pytest.mark.parametrize(
    ("events", "queued", "polled"),
    [
        ([REQUEST], True, True), ([REQUEST, REQUEST], False, False),
        ([REQUEST, LEFT], False, True), ([LEFT], False, True), ([], True, False),
    ],
)  # fmt: skip
def test_a_decision_uses_the_newest_readings(events, queued, polled) -> None:
    """Requests for work decide nothing without a queued process, so readings wait for the tick."""
    readings = object()
    endpoint = MasterEndpoint.__new__(MasterEndpoint)
    endpoint._guard = CallbackGuard()
    endpoint._subscriptions = SimpleNamespace(poll_readings=lambda: readings)
    endpoint.events = list(events)
    assert endpoint.take_events(queued=queued) == ([readings] if polled else []) + events
    assert endpoint.events == []
