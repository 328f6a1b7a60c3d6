"""The gateway without HTTP: its links to the master, and what all requests share."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rosrm.archive.reader import LogArchive
from rosrm.errors import NoMaster
from rosrm_web.changes import Broadcast, master_part
from rosrm_web.listings import Listings
from rosrm_web.master_link import MasterLink
from rosrm_web.watching import Watcher

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.retrying import Notify
    from rosrm.model.rows import Listing

T = TypeVar("T")

#: Seconds for which the end waits for present requests.
_LEAVING: Final = 5.0


class Gateway:
    """Links to the master.

    Each has a client of its own, so that a silent slave delays only those who read logs, and a
    request that waits does not delay the listings.

    Args:
        connect: returns a client of the master.
        archive: directory of a log archive; None: there is none.

    Attributes:
        reading: listings, and the regular requests of the watcher.
        acting: requests that act, and explanations.
        logs: logs, which the slaves send.
        watcher: checks regularly that the master answers.
        broadcast: passes changes to the readers of `/v1/changes`.
    """

    def __init__(self, connect: Callable[[Notify], Client], archive: Path | None = None) -> None:
        self._archive = archive
        self.reading = MasterLink("reading", connect)
        self.acting = MasterLink("acting", connect)
        self.logs = MasterLink("logs", connect)
        self.watcher = Watcher(self.reading)
        self._listings = Listings(self.reading)
        self.broadcast = Broadcast()
        # First, so that no reader of an event gets a listing from before it.
        self.watcher.on_events.append(lambda _: self.forget_listings())
        self.watcher.on_events.append(self.broadcast.send_events)
        self.watcher.on_new_journal.append(self.broadcast.send_reset)
        self.watcher.on_master.append(lambda master: self.broadcast.send(master_part(master)))

    def open_archive(self) -> LogArchive | None:
        """Return the log archive as it is now, for the link that reads logs; raises `Refused`."""
        return None if self._archive is None else LogArchive(self._archive)

    async def ask(self, link: MasterLink, request: Callable[[Client], T]) -> T:
        """Return the result of a request; without a master, refuse it at once.

        Raises:
            NoMaster: the master is lost, or was never found.
            RosrmError: as `MasterLink.ask`.
        """
        self._require_master()
        return await link.ask(request)

    async def list(self, **parts: Any) -> Listing:
        """Return a recent listing, as `Listings.get`; otherwise as `ask`."""
        self._require_master()
        return await self._listings.get(**parts)

    def forget_listings(self) -> None:
        """Read everything again, because a request may have changed it."""
        self._listings.forget()

    def _require_master(self) -> None:
        if self.watcher.master.state != "up":
            raise NoMaster(self.watcher.master.reason)

    def close(self) -> None:
        """Leave ROS, as far as the present requests end in time.

        Otherwise the shared memory of the clients would remain after the end of this process.
        """
        left = [link.close() for link in (self.reading, self.acting, self.logs)]
        wait(left, _LEAVING)
