"""The service that watches for alerts, without a cluster."""

from __future__ import annotations

from contextlib import ExitStack, closing
from types import SimpleNamespace

import pytest

from rosrm import EventRow, Listing, NoMaster, Refused
from rosrm_alerts.conditions import Alert, NoAnswer
from rosrm_alerts.outbox import Outbox as OutboxFile
from rosrm_alerts.outbox import OutboxError
from rosrm_alerts.service import AlertService


class Outbox:
    """An outbox that takes no notice."""

    def active(self):
        return {}

    def position(self):
        return None

    def last_event(self):
        return None

    def commit(self, *_):
        return 0


@pytest.mark.parametrize(
    "fault",
    [
        NoMaster("no master answers"),
        Refused("the master is of another version"),
        OSError(24, "Too many open files"),
        RuntimeError("failed to create a subscription"),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_whatever_prevents_a_listing_counts_as_no_answer(monkeypatch, fault) -> None:
    """Otherwise the service would end, and no alert would tell that nothing is watched."""
    boot = [1000.0]
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: boot[0])

    def connect():
        raise fault

    file = SimpleNamespace(alerts=[Alert("silent", NoAnswer(), lasts=3.0)], forwarded=())
    service = AlertService(file, {}, Outbox(), connect)
    begun = []
    observe = service._watch.observe
    monkeypatch.setattr(
        service._watch, "observe", lambda *a: begun.extend(found := observe(*a)) or found
    )
    for _ in range(5):
        boot[0] += 1.0
        service._look()
    assert [change.alert.name for change in begun] == ["silent"]


def test_a_clock_that_is_set_neither_begins_nor_delays_an_alert(monkeypatch, caplog) -> None:
    """An alert begins when its condition has held for its time; its notice has the set time."""
    boot, wall = [1000.0], [1.7e9]
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: boot[0])
    monkeypatch.setattr("rosrm.clocks.wall_time", lambda: wall[0])

    def connect():
        raise NoMaster("no master answers")

    file = SimpleNamespace(alerts=[Alert("silent", NoAnswer(), lasts=30.0)], forwarded=())
    service = AlertService(file, {}, Outbox(), connect)
    begun = []
    observe = service._watch.observe
    monkeypatch.setattr(
        service._watch, "observe", lambda *a: begun.extend(found := observe(*a)) or found
    )
    for step in range(40):
        boot[0] += 1.0
        wall[0] = 1.7e9 + step + (3600.0 if step % 2 else -3600.0)
        service._look()
        assert bool(begun) is (step >= 30), step


def test_a_full_disk_of_the_outbox_does_not_end_the_watch(monkeypatch, caplog) -> None:
    """The notices wait in memory, and are stored with the position once there is room."""
    boot, stored, is_full = [1000.0], [], [True]
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: boot[0])

    class FullOutbox(Outbox):
        def commit(self, notices, *_):
            if is_full[0]:
                raise OutboxError("notices cannot be stored: database or disk is full")
            stored.extend(notices)
            return 0

    def connect():
        raise NoMaster("no master answers")

    told = []
    file = SimpleNamespace(
        alerts=[Alert("silent", NoAnswer(), to=("hook",), lasts=3.0)], forwarded=()
    )
    service = AlertService(file, {}, FullOutbox(), connect)
    service._deliveries["hook"] = SimpleNamespace(notify=lambda: told.append(len(stored)))
    for step in range(8):
        is_full[0] = step < 6
        boot[0] += 1.0
        service._look()
    assert [(sink, notice.alert) for sink, notice in stored] == [("hook", "silent")]
    assert told == [1]
    assert caplog.text.count("database or disk is full") == 1


def event(sequence: int, run: int) -> EventRow:
    return EventRow(sequence, 1000.0 * run + sequence, 0.0, "host_up", "", "", f"run {run}")


class Record:
    """A master's record of events."""

    def __init__(self, *events: EventRow) -> None:
        self.events = events

    def list(self, after=0, newest=0, **_):
        events = [one for one in self.events if one.sequence > after][-newest:]
        return Listing("m", 1.0, self.events[-1].sequence, events=events)

    def close(self):
        pass


@pytest.mark.parametrize("is_restarted", [False, True])
@pytest.mark.parametrize("kept", [90, 93, 0], ids=["gap", "no gap", "another journal"])
def test_events_of_a_run_after_a_journal_gap_are_seen_once(tmp_path, kept, is_restarted) -> None:
    """Their sequences are those of lost events that the service has seen."""
    before = [event(number, 1) for number in range(80, 94)]
    record = Record(*before)
    file = SimpleNamespace(alerts=(), forwarded=())
    with ExitStack() as closing_all:

        def begun() -> AlertService:
            outbox = closing_all.enter_context(closing(OutboxFile(tmp_path / "o" / "outbox")))
            return AlertService(file, {}, outbox, lambda: record)

        service = begun()
        service._look()
        record.events = (*before, event(94, 1))
        service._look()
        if is_restarted:
            closing_all.close()
            service = begun()
        new = [event(kept + number, 2) for number in range(1, 9)]
        record.events = (*[one for one in before if one.sequence <= kept], *new)
        assert service._ask() == tuple(new)
        assert service._ask() == ()
