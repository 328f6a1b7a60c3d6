"""Read-only requests: answered one in each turn of the loop, in turns between their senders."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rosrm.model.ledger import Store, bound_of
from rosrm.model.requester import Requester


class FairReads:
    """Waiting read-only requests of each sender.

    A listing may take as long as a hundred commands. So a sender with many of them delays neither
    the commands of others nor their listings. Requests beyond the bound of a sender are dropped;
    clients repeat a request without an answer.

    Args:
        post: calls a function in the loop, after the messages that have arrived.
    """

    def __init__(self, post: Callable[[Callable[[], None]], None]) -> None:
        self._post = post
        self._waiting: dict[str, deque[Callable[[], None]]] = {}

    def add(self, sender: Requester, answer: Callable[[], None]) -> None:
        """Answer a request in its turn."""
        waiting = self._waiting.get(sender.name, ())
        if len(waiting) >= bound_of(Store.LISTINGS, is_operator=sender.is_operator).number:
            return
        if not self._waiting:
            self._post(self._next)
        self._waiting.setdefault(sender.name, deque()).append(answer)

    def _next(self) -> None:
        name, waiting = next(iter(self._waiting.items()))
        answer = waiting.popleft()
        del self._waiting[name]
        if waiting:
            self._waiting[name] = waiting  # behind the other senders
        if self._waiting:
            self._post(self._next)
        answer()
