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
    ("events", "queued", "awaited", "polled"),
    [
        ([REQUEST], True, False, True), ([REQUEST, REQUEST], False, False, False),
        ([REQUEST, LEFT], False, False, True), ([LEFT], False, False, True),
        ([], True, False, False), ([], False, True, True),
    ],
)  # fmt: skip
def test_a_decision_uses_the_newest_readings(events, queued, awaited, polled) -> None:
    """Requests for work decide nothing without a queued process, so readings wait for the tick.

    They do not wait if they are the first of a slave, which gets no work before.
    """
    readings = object()
    endpoint = MasterEndpoint.__new__(MasterEndpoint)
    endpoint._guard = CallbackGuard()
    endpoint.links = SimpleNamespace(awaits_readings=awaited)
    endpoint._subscriptions = SimpleNamespace(poll_readings=lambda: readings)
    endpoint.events = list(events)
    assert endpoint.take_events(queued=queued) == ([readings] if polled else []) + events
    assert endpoint.events == []
