"""Regular listings of the cluster, while a browser shows the page."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.errors import RosrmError
from rosrm_web.tasks import serve_always
from rosrm_web.watching import give_up_early

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import EventRow, Listing
    from rosrm_web.gateway import Gateway

#: Seconds between two listings of the hosts without an event.
PERIOD: Final = 1.0
#: Likewise of everything: thousands of processes take much longer.
WHOLE_PERIOD: Final = 2.0
#: Events that a new page shows.
MOST_EVENTS: Final = 500

_log = logging.getLogger("rosrm.web")


class Live:
    """The newest listing of hosts and processes, and the newest events.

    Attributes:
        listing: None: there is none yet.
        applications: the newest listing with applications and modes; None: there is none.
        readers_of_applications: functions of `join` that need `applications`; without any, they are
            not read.
        events: the newest ones, the oldest first.
        on_change: called after each listing, and when the master is lost or back.
    """

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._woken = asyncio.Event()
        self._whole_at = 0.0
        self.listing: Listing | None = None
        self.applications: Listing | None = None
        self.readers_of_applications: set[Callable[[], None]] = set()
        self.events: deque[EventRow] = deque(maxlen=MOST_EVENTS)
        self.on_change: list[Callable[[], None]] = []
        self._task: asyncio.Task[None] | None = None
        gateway.watcher.on_events.append(self._take_events)
        gateway.watcher.on_new_journal.append(self._forget_events)
        gateway.watcher.on_master.append(lambda _: self._woken.set())

    def join(self, on_change: Callable[[], None]) -> None:
        """Call a function after each change, until `leave`."""
        self.on_change.append(on_change)
        self._woken.set()
        if self._task is None:
            self._task = serve_always(self._run, "live")

    def leave(self, on_change: Callable[[], None]) -> None:
        """End the calls of a function; without any, nothing is read."""
        self.on_change.remove(on_change)
        self.readers_of_applications.discard(on_change)
        if not self.on_change and self._task is not None:
            self._task.cancel()
            self._task = self.listing = None

    def wake(self) -> None:
        """Read now, because an action may have changed something."""
        self._gateway.forget_listings()
        self._woken.set()

    async def _run(self) -> None:
        while True:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._woken.wait(), PERIOD)
            is_due = self._woken.is_set() or clocks.boot_time() >= self._whole_at
            self._woken.clear()
            await (self._read() if is_due else self._read_hosts())
            for call in list(self.on_change):
                try:
                    call()
                except Exception:  # noqa: BLE001 - one browser must not stop the others
                    _log.exception("the page of a browser cannot be updated")

    async def _read_hosts(self) -> None:
        with suppress(RosrmError):  # the watcher has the state of the master
            hosts = await self._gateway.list(hosts=True)
            if self.listing is not None:
                self.listing = replace(self.listing, hosts=hosts.hosts, uptime=hosts.uptime)

    async def _read(self) -> None:
        self._whole_at = clocks.boot_time() + WHOLE_PERIOD
        try:
            if self.readers_of_applications:
                self.listing = self.applications = await self._gateway.list(
                    hosts=True, processes=True, applications=True, modes=True
                )
            else:
                self.listing = await self._gateway.list(hosts=True, processes=True)
            if not self.events:
                self.events.extend(await self._gateway.ask(self._gateway.reading, _newest))
        except RosrmError:
            return  # the watcher has the state of the master

    def _forget_events(self) -> None:
        self.events.clear()
        self._woken.set()  # reads those of the new journal, which may be no news to the watcher

    def _take_events(self, rows: Sequence[EventRow]) -> None:
        if self.events:
            self.events.extend(rows)
        self._woken.set()


def _newest(client: Client) -> Sequence[EventRow]:
    return client.list(events=True, newest=MOST_EVENTS, on_wait=give_up_early).events
