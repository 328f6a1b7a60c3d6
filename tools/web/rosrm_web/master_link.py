"""Requests to the master, one after the other in a thread with its own client."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, TypeVar

from rosrm.errors import RosrmError

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.retrying import Notify

T = TypeVar("T")

#: Highest number of requests that wait for the thread of a link.
MOST_WAITING: Final = 32

_log = logging.getLogger("rosrm.web")


class Busy(RosrmError):
    """The gateway has too many open requests, and sent none of them to the master."""


class MasterLink:
    """A thread with a client of the master, which connects at the first request.

    The client stays connected while the master is away, and finds the next run of the master.

    Attributes:
        notes: sentences of the client about the present request, for the thread of the link.
    """

    def __init__(self, name: str, connect: Callable[[Notify], Client]) -> None:
        self._connect = connect
        self._executor = ThreadPoolExecutor(1, thread_name_prefix=f"rosrm-web-{name}")
        self._client: Client | None = None
        self._waiting = 0
        self.notes: list[str] = []

    async def ask(self, request: Callable[[Client], T]) -> T:
        """Return the result of a request.

        Raises:
            Busy: `MOST_WAITING` requests are waiting already.
            RosrmError: of the client.
        """
        if self._waiting >= MOST_WAITING:
            raise Busy(f"{MOST_WAITING} requests are waiting for the master; try again later")
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._executor, self._run, request)
        finally:
            self._waiting -= 1

    def _run(self, request: Callable[[Client], T]) -> T:
        self.notes.clear()
        if self._client is None:
            self._client = self._connect(self._note)
        return request(self._client)

    def _note(self, text: str) -> None:
        self.notes.append(text)
        _log.info("%s", text)

    def close(self) -> Future[None]:
        """Leave ROS after the present and the waiting requests; return that end."""
        left = self._executor.submit(self._leave)
        self._executor.shutdown(wait=False)
        return left

    def _leave(self) -> None:
        if self._client is not None:
            self._client.close()
