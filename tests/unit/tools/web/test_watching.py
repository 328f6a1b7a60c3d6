"""The watcher of the master outlives failures of its readers, and its client leaves in the end."""

from __future__ import annotations

import asyncio
import threading

import pytest

from rosrm import threads
from rosrm.model.rows import EventRow, Listing
from rosrm_web.gateway import Gateway
from rosrm_web.master_link import MOST_WAITING, Busy
from rosrm_web.tasks import serve_always
from rosrm_web.watching import MasterState


class Master:
    """A client of a master with one more event each time."""

    def __init__(self) -> None:
        self.newest = 0

    def list(self, **_):
        self.newest += 1
        event = EventRow(self.newest, 1.7e9, 1.0, "assigned", "p", "a", "")
        return Listing("m", 1.0, self.newest, events=[event])

    def master_load(self):
        """Return nothing: no load was published."""

    def close(self):
        """Leave nothing."""


def test_a_reader_of_events_that_fails_stops_neither_the_others_nor_the_watcher():
    """Otherwise the page would still show the master as up, and no new event."""

    async def scene() -> None:
        gateway = Gateway(lambda _: Master())
        seen: list[int] = []
        third = asyncio.Event()

        def fail(_: object) -> None:
            raise KeyError("fact")

        def read(rows) -> None:
            seen.extend(row.sequence for row in rows)
            if len(seen) == 3:
                third.set()

        gateway.watcher.on_events[:] = [fail, read]
        watching = asyncio.create_task(gateway.watcher.run())
        await asyncio.wait_for(third.wait(), 30.0)
        assert seen[:3] == [1, 2, 3]
        watching.cancel()
        gateway.close()

    asyncio.run(scene())


class Journal(Master):
    """A client of a master whose events all have one time, that of the journal."""

    def __init__(self) -> None:
        self.began, self.newest = 1.7e9, 3

    def list(self, after=0, **_):
        """Return the events after a sequence."""
        numbers = range(after + 1, self.newest + 1)
        events = [EventRow(n, self.began, 1.0, "assigned", "p", "a", "") for n in numbers]
        return Listing("m", 1.0, self.newest, events=events)


def test_a_new_journal_that_has_overtaken_the_old_one_is_noticed():
    """The last sequence alone does not show it. All events of the new journal are reported."""

    async def scene() -> None:
        journal = Journal()
        gateway = Gateway(lambda _: journal)
        watcher, seen, resets = gateway.watcher, [], []
        watcher.on_events[:] = [lambda rows: seen.extend(row.sequence for row in rows)]
        watcher.on_new_journal[:] = [lambda: resets.append(len(seen))]
        await watcher.look()
        seen.clear()
        journal.newest = 4
        for _ in range(2):
            await watcher.look()
        assert (seen, resets) == ([4], [])
        journal.began, journal.newest = 1.8e9, 6
        for _ in range(3):
            await watcher.look()
        assert (seen, resets) == ([4, 1, 2, 3, 4, 5, 6], [1])
        gateway.close()

    asyncio.run(scene())


def test_a_gateway_with_too_many_requests_does_not_count_its_master_as_lost():
    """The watcher cannot ask then, which says nothing about the master."""

    async def scene() -> None:
        gateway = Gateway(lambda _: Master())
        await gateway.watcher.look()
        free = threading.Event()
        waiting = [
            asyncio.create_task(gateway.reading.ask(lambda _: free.wait(30.0)))
            for _ in range(MOST_WAITING)
        ]
        await asyncio.sleep(0)  # each task sends its request
        with pytest.raises(Busy):
            await gateway.watcher.look()
        assert gateway.watcher.master.state == "up"
        free.set()
        assert all(await asyncio.gather(*waiting))
        gateway.close()

    asyncio.run(scene())


def test_the_end_waits_until_the_client_has_left():
    """The command then ends without the interpreter's own end, and so without waiting threads."""
    asked, ended, left = threading.Event(), threading.Event(), threading.Event()

    class Late(Master):
        def list(self, **_):
            asked.set()
            assert ended.wait(30.0)
            return super().list()

        def close(self):
            left.set()

    async def scene() -> None:
        gateway = Gateway(lambda _: Late())
        watching = asyncio.create_task(gateway.watcher.run())
        assert await asyncio.to_thread(asked.wait, 30.0)
        watching.cancel()
        threading.Timer(0.2, ended.set).start()
        gateway.close()
        assert left.is_set()

    asyncio.run(scene())


class Choked(Master):
    """A client of a process that can open no further file for a while."""

    def __init__(self) -> None:
        super().__init__()
        self.left = 2

    def list(self, **options):
        """Raise twice an error that is no error of rosrm."""
        self.left -= 1
        if self.left >= 0:
            raise OSError(24, "Too many open files")
        return super().list(**options)


def test_the_watcher_outlives_an_error_that_is_none_of_the_masters(monkeypatch):
    """Otherwise the page would show the last state of the master for ever."""
    monkeypatch.setattr(threads, "FIRST_PAUSE", 0.01)

    async def scene() -> None:
        gateway = Gateway(lambda _: Choked())
        states, up = [], asyncio.Event()

        def note(master) -> None:
            states.append(master)
            if master.state == "up":
                up.set()

        gateway.watcher.master = MasterState("up", "")
        gateway.watcher.on_master[:] = [lambda _: 1 / 0, note]
        watching = serve_always(gateway.watcher.run, "watcher")
        await asyncio.wait_for(up.wait(), 30.0)
        watching.cancel()
        gateway.close()
        assert [one.state for one in states] == ["searching", "up"]
        assert "Too many open files" in states[0].reason

    asyncio.run(scene())
