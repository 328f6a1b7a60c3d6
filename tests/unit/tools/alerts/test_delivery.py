"""The thread of a sink outlives errors of the outbox."""

from __future__ import annotations

import sqlite3
import threading
from types import SimpleNamespace

from rosrm import Notice, threads
from rosrm.extensions.guarded_sink import GuardedSink
from rosrm_alerts.delivery import Delivery

PATIENCE = 10.0


class Outbox:
    """An outbox whose disk fails at first."""

    def __init__(self) -> None:
        self.failures, self.notices = 2, [SimpleNamespace(notice=Notice("1", 1.0, "try", "x"))]

    def waiting(self, *_):
        self.failures -= 1
        if self.failures >= 0:
            raise sqlite3.OperationalError("disk I/O error")
        return self.notices

    def delivered(self, _):
        self.notices = []


class Sink:
    """A sink that notes what it takes."""

    def __init__(self) -> None:
        self.taken = threading.Event()

    def send(self, _):
        self.taken.set()

    def close(self):
        """Release nothing."""


def test_a_disk_that_fails_for_a_while_ends_no_delivery(monkeypatch):
    """Otherwise the sink would get no further notice, without a message."""
    monkeypatch.setattr(threads, "FIRST_PAUSE", 0.01)
    sink = Sink()
    delivery = Delivery("a", GuardedSink("a", sink), Outbox())
    assert sink.taken.wait(PATIENCE), "the sink got no notice"
    delivery.close(PATIENCE)
