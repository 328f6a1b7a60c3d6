"""Recent listings: readers at the same time share one request to the master."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rosrm import clocks
from rosrm_web.watching import give_up_early

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.rows import Listing
    from rosrm_web.master_link import MasterLink

#: Seconds for which a listing is used again.
FRESH: Final = 0.25


@dataclass
class _Recent:
    """A request for a listing, and the monotonic second of its beginning."""

    task: asyncio.Task[Listing]
    begun: float

    @property
    def is_usable(self) -> bool:
        if not self.task.done():
            return True
        is_failed = self.task.cancelled() or self.task.exception() is not None
        return not is_failed and clocks.boot_time() - self.begun < FRESH


def _list(client: Client, parts: dict[str, Any]) -> Listing:
    return client.list(**parts, on_wait=give_up_early)


class Listings:
    """The newest listing of each request."""

    def __init__(self, link: MasterLink) -> None:
        self._link = link
        self._recent: dict[frozenset[tuple[str, Any]], _Recent] = {}

    async def get(self, **parts: Any) -> Listing:
        """Return the requested parts, as `Client.list`."""
        key = frozenset(parts.items())
        recent = self._recent.get(key)
        if recent is None or not recent.is_usable:
            request = self._link.ask(partial(_list, parts=parts))
            recent = _Recent(asyncio.create_task(request), clocks.boot_time())
            self._recent[key] = recent
        return await asyncio.shield(recent.task)  # a reader that leaves stops no other reader

    def forget(self) -> None:
        """Read everything again at the next request, because an action may have changed it."""
        self._recent.clear()
