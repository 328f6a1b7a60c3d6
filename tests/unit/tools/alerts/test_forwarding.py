"""The service of alerts: which events it forwards."""

from __future__ import annotations

import pytest

from rosrm.extensions.guarded_sink import GuardedSink
from rosrm.model.rows import EventRow, Listing
from rosrm_alerts.alerts_file import AlertsFile
from rosrm_alerts.file_forms import Forwarded
from rosrm_alerts.outbox import Outbox
from rosrm_alerts.service import AlertService


def event(number: int, message: str = "old") -> EventRow:
    return EventRow(number, 1.7e9 + number, 1.0, "assigned", "p", "a", message)


class Master:
    """A client of a master with these events."""

    def __init__(self, events):
        self.events = events

    def list(self, *, after, newest, **_):
        rows = [one for one in self.events if one.sequence > after][-newest:]
        return Listing("m", 1.0, max(one.sequence for one in self.events), events=rows)


class Sink:
    """A sink whose notices stay in the outbox."""

    def send(self, notices):
        raise OSError("not now")

    def close(self):
        """Leave nothing."""


@pytest.mark.parametrize("number", [1, 2, 5])
def test_events_after_a_journal_gap_are_forwarded_once(tmp_path, number):
    """They have the sequences of lost events, which were forwarded."""
    outbox = Outbox(tmp_path / "outbox")
    master = Master([event(1), event(2)])
    file = AlertsFile(forwarded=(Forwarded(to=("sink",)),))
    service = AlertService(file, {"sink": (GuardedSink("sink", Sink()), 1)}, outbox, lambda: master)
    service._look()
    master.events = [event(one) for one in range(1, 5)]
    service._look()
    news = [event(3 + one, f"new {one}") for one in range(number)]
    master.events = [event(1), event(2), *news]
    service._look()
    service._look()
    texts = [one.notice.message for one in outbox.waiting("sink", 100)]
    assert texts == ["old", "old"] + [one.message for one in news]
    service._deliveries["sink"].close(5.0)
    outbox.close()
