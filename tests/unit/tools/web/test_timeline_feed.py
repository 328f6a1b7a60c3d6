"""The events of the timeline: read once, then followed."""

from __future__ import annotations

import asyncio

from rosrm.model.rows import EventRow, Listing
from rosrm_web.gateway import Gateway
from rosrm_web.page.timeline_feed import FIRST, Feed
from rosrm_web.watching import MOST_EVENTS
from tests.unit.tools.report.runs import events


class Master:
    """A client of a master with these events."""

    def __init__(self) -> None:
        self.rows = events(
            (0, "assigned", "p", "a", "", {"number": 1, "decision": {}}), (1, "running", "p", "a")
        )
        self.reads = 0

    def list(self, *, events: bool = False, after: int = 0, newest: int = 0, **_) -> Listing:
        self.reads += events
        last = self.rows[-1].sequence
        rows = [one for one in self.rows if one.sequence > after][-(newest or 1000) :]
        return Listing("m", 1.0, last, events=rows)

    def master_load(self):
        """Return nothing: no load was published."""

    def close(self):
        """Leave nothing."""


def placements(feed: Feed) -> list[str]:
    return [one.process for one in feed.timeline.processes.histories(9.0).placements]


def row(sequence: int, process: str) -> EventRow:
    return EventRow(sequence, 1.7e9, float(sequence), "assigned", process, "a", "")


async def started() -> tuple[Master, Gateway, Feed]:
    """Return a master, a gateway that has found it, and the feed of the gateway."""
    master = Master()
    gateway = Gateway(lambda _: master)
    await gateway.watcher.look()
    return master, gateway, Feed(gateway)


def test_the_events_are_read_once_and_then_followed():
    """All browsers share the events; an event that is read twice counts once."""

    async def scene() -> None:
        master, gateway, feed = await started()
        feed.take([row(2, "early")])
        await asyncio.gather(feed.read(), feed.read())
        assert (placements(feed), feed.newest, master.reads) == (["p"], 2, 1)

        feed.take([row(2, "again"), row(3, "q")])
        assert (placements(feed), feed.newest) == (["p", "q"], 3)
        gateway.close()

    asyncio.run(scene())


def test_a_burst_that_may_have_a_gap_is_read_again():
    """The watcher leaves out the oldest events of a large burst."""

    async def scene() -> None:
        master, gateway, feed = await started()
        await feed.read()
        feed.take([row(10 + number, "late") for number in range(MOST_EVENTS)])
        assert placements(feed) == ["p"]
        master.rows.append(row(3000, "q"))
        await feed.read()
        assert (placements(feed), feed.newest, master.reads) == (["p", "q"], 3000, 2)
        gateway.close()

    asyncio.run(scene())


def test_events_of_a_new_journal_replace_those_of_the_former():
    """Another master has no journal of the former, so its sequences begin again."""

    async def scene() -> None:
        master, gateway, feed = await started()
        await feed.read()
        master.rows = [row(1, "new")]
        await gateway.watcher.look()
        assert (placements(feed), feed.newest) == ([], 0)
        await feed.read()
        assert (placements(feed), feed.newest) == (["new"], 1)
        master.rows.append(row(2, "newer"))
        await gateway.watcher.look()
        assert (placements(feed), feed.newest) == (["new", "newer"], 2)
        gateway.close()

    asyncio.run(scene())


def test_older_events_are_read_on_request():
    """The first reading is short; a user may ask for all that the master sends."""

    async def scene() -> None:
        master, gateway, feed = await started()
        master.rows += [row(3 + number, "late") for number in range(FIRST)]
        await gateway.watcher.look()
        await feed.read()
        assert ("p" in placements(feed), feed.has_older) == (False, True)
        await feed.read_older()
        assert ("p" in placements(feed), feed.has_older) == (True, False)
        gateway.close()

    asyncio.run(scene())
