"""Measurements of links that are due, and the addresses of slaves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from typing import Final

from rosrm.core.master.state.backoff import Backoff

#: Longest time, in seconds, until a host that refuses to measure is asked again.
_LONGEST_WAIT: Final = 600.0


class LinkQueries:
    """Hosts in the order in which they measure their links; the addresses of their slaves.

    Attributes:
        places: name of a host to the addresses and the port on which its slave answers packets.
        probed_at: time of the last measurement with peers.
    """

    def __init__(self) -> None:
        self.places: dict[str, tuple[tuple[str, ...], int]] = {}
        self.probed_at = -inf
        self._due: dict[str, float] = {}
        self._turns: dict[str, int] = {}
        self._refusals: dict[str, Backoff] = {}

    def begin(self, host: str, now: float) -> None:
        """Let a host measure its links from now on; the address of its former slave is void."""
        self.remove(host)
        self.add(host, now)

    def add(self, host: str, at: float) -> None:
        """Let a host measure its links from a time on, after the hosts that wait already."""
        self._due.pop(host, None)
        self._due[host] = at

    def remove(self, host: str) -> None:
        """Ask a host no more, and forget its address."""
        for table in (self._due, self.places, self._refusals):
            table.pop(host, None)

    def note_refusal(self, host: str, now: float, period: float) -> None:
        """Ask a host that has refused to measure again later, with back-off."""
        wait = self._refusals.setdefault(host, Backoff()).note(now, period, _LONGEST_WAIT)
        self.add(host, now + wait)

    def note_success(self, host: str) -> None:
        """Forget the refusals of a host that measures."""
        self._refusals.pop(host, None)

    def take_due(self, now: float) -> str | None:
        """Remove and return the first host whose measurement is due; None: there is none."""
        host = next((one for one, at in self._due.items() if at <= now), None)
        if host is not None:
            del self._due[host]
        return host

    def peers(self, host: str, most: int) -> Iterator[str]:
        """Return the next peers of a host: all others with a known address, by turns."""
        others: Sequence[str] = [name for name in self.places if name != host]
        first = self._turns.get(host, 0)
        count = min(most, len(others))
        self._turns[host] = (first + count) % max(1, len(others))
        for turn in range(first, first + count):
            yield others[turn % len(others)]
