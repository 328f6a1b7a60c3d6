"""GET /metrics."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from fastapi.responses import Response

from rosrm import clocks
from rosrm.errors import NoMaster
from rosrm_web.metrics import table
from rosrm_web.metrics.counting import EventMetrics
from rosrm_web.metrics.exposition import MEDIA_TYPE, exposition

if TYPE_CHECKING:
    from rosrm.model.rows import Listing
    from rosrm_web.access import Access
    from rosrm_web.gateway import Gateway


class Metrics:
    """Endpoint with the metrics; counts the events from now on."""

    def __init__(self, gateway: Gateway, access: Access) -> None:
        self._gateway, self._access = gateway, access
        self._counted = EventMetrics()
        gateway.watcher.on_events.append(self._counted.count)

    async def metrics(self) -> Response:
        """Return all metrics as text for Prometheus, also while the master is lost."""
        listing: Listing | None = None
        begun = clocks.boot_time()
        with suppress(NoMaster):
            listing = await self._gateway.list(
                hosts=True, processes=True, applications=True, plugins="failing"
            )
        seconds = clocks.boot_time() - begun
        load = self._gateway.watcher.load
        own = [(table.TOKENS, (), float(bool(self._access.trouble)))]
        write = partial(exposition, listing, seconds, self._counted, load, own)
        content = await asyncio.get_running_loop().run_in_executor(None, write)
        return Response(content, media_type=MEDIA_TYPE)
