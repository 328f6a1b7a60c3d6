"""The page's regular listings: for all browsers, and only while there is one."""

from __future__ import annotations

import asyncio

from rosrm.model.rows import EventRow, Listing
from rosrm_web.gateway import Gateway
from rosrm_web.page.live import Live


class Master:
    """A client of a master that is always there."""

    newest = 1

    def __init__(self):
        self.asked = []

    def list(self, **parts):
        self.asked.append(parts)
        event = EventRow(self.newest, 1.7e9, 1.0, "assigned", "p", "a", "")
        processes = ["p"] if parts.get("processes") else []
        return Listing("m", 1.0, self.newest, processes=processes, events=[event])

    def master_load(self):
        """Return nothing: no load was published."""

    def close(self):
        """Leave nothing."""


async def started(master: Master) -> tuple[Gateway, Live]:
    gateway = Gateway(lambda _: master)
    await gateway.watcher.look()
    return gateway, Live(gateway)


def test_a_browser_that_cannot_be_updated_stops_no_other():
    """Its error is logged, and the next change reaches the others."""

    async def scene() -> None:
        gateway, live = await started(Master())
        seen, times = asyncio.Event(), 0

        def broken() -> None:
            raise RuntimeError("this browser is gone")

        def well() -> None:
            nonlocal times
            times += 1
            live.wake()
            if times == 3:
                seen.set()

        live.join(broken)
        live.join(well)
        await asyncio.wait_for(seen.wait(), 30.0)
        live.leave(broken)
        live.leave(well)
        gateway.close()

    asyncio.run(scene())


def test_nothing_is_read_while_nobody_looks():
    """The last browser that leaves ends the requests to the master."""

    async def scene() -> None:
        gateway, live = await started(Master())
        live.join(lambda: None)
        reading = asyncio.all_tasks() - {asyncio.current_task()}
        assert reading
        live.leave(live.on_change[0])
        _, still_reading = await asyncio.wait(reading, timeout=30.0)
        assert not still_reading
        gateway.close()

    asyncio.run(scene())


def test_hosts_are_read_more_often_than_processes():
    """A listing of hosts alone keeps the processes that are known."""

    async def scene() -> None:
        master = Master()
        gateway, live = await started(master)
        hosts_alone = asyncio.Event()

        def look() -> None:
            parts = master.asked[-1]
            if parts.get("hosts") and not parts.get("processes"):
                assert live.listing.processes == ["p"]
                hosts_alone.set()

        live.join(look)
        await asyncio.wait_for(hosts_alone.wait(), 30.0)
        live.leave(look)
        gateway.close()

    asyncio.run(scene())


def test_an_event_makes_older_listings_void():
    """Otherwise a page would show the state from before the event for a second."""

    async def scene() -> None:
        master = Master()
        gateway, _ = await started(master)
        await gateway.list(hosts=True)
        before = len(master.asked)
        await gateway.list(hosts=True)
        assert len(master.asked) == before  # the same listing again

        master.newest = 2
        await gateway.watcher.look()
        await gateway.list(hosts=True)
        assert master.asked[-1]["hosts"]
        gateway.close()

    asyncio.run(scene())


def test_the_events_of_a_former_journal_are_dropped():
    """The higher sequences of these events would hide the new events."""

    async def scene() -> None:
        master = Master()
        master.newest = 7
        gateway, live = await started(master)
        changed = asyncio.Event()
        live.join(changed.set)
        await asyncio.wait_for(changed.wait(), 30.0)
        assert live.events[-1].sequence == 7

        master.newest = 1
        await gateway.watcher.look()
        changed.clear()
        await asyncio.wait_for(changed.wait(), 30.0)
        assert [one.sequence for one in live.events] == [1]
        live.leave(changed.set)
        gateway.close()

    asyncio.run(scene())


def test_listings_with_other_filters_are_other_listings():
    """A listing of the failing plugins is no listing of all."""

    async def scene() -> None:
        master = Master()
        gateway, _ = await started(master)
        before = len(master.asked)
        for plugins in (True, "failing", True, "failing"):
            await gateway.list(plugins=plugins)
        asked = [parts["plugins"] for parts in master.asked[before:]]
        assert asked == [True, "failing"]

    asyncio.run(scene())
