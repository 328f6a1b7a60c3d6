"""Back-off of retries, and the memory of what has failed."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Final

#: Failures in a row beyond which the wait is the longest one in any case.
_MOST: Final = 32


@dataclass(slots=True)
class Backoff:
    """Time of the next try; each failure in a row doubles the wait for it.

    Attributes:
        tries: failures in a row.
        until: time of the next try; -inf: at once.
    """

    tries: int = 0
    until: float = -inf

    def note(self, now: float, first: float, longest: float) -> float:
        """Note a failure; return the seconds until the next try.

        `first`, `longest`: wait after the first failure, and the longest one.
        """
        wait = min(first * 2.0**self.tries, max(first, longest))
        self.tries, self.until = min(self.tries + 1, _MOST), now + wait
        return wait


class Retries:
    """Memory of failed tries by what was tried, such as the destination of a move.

    Two waits follow a failure: one until the same is tried again, and a shorter one until anything
    is tried. Both double with each failure in a row.
    """

    #: Wait, in seconds, after the first failure, and the longest one.
    FIRST: Final = 2.0
    LONGEST: Final = 600.0

    def __init__(self) -> None:
        self._of: dict[str, tuple[str, Backoff]] = {}
        self._all = Backoff()
        self._newest = ""

    def note(self, what: str, why: str, now: float, first: float) -> None:
        """Note why a try has failed; `first`: seconds until the same may be tried again."""
        _, backoff = self._of.get(what, ("", Backoff()))
        backoff.note(now, max(first, self.FIRST), self.LONGEST)
        self._all.note(now, self.FIRST, self.LONGEST)
        self._of[what], self._newest = (why, backoff), why

    def why_none(self, now: float) -> str:
        """Return the newest failure if nothing may be tried yet; "": something may."""
        return self._newest if now < self._all.until else ""

    def waiting(self, now: float) -> dict[str, str]:
        """Return what may not be tried again yet, each with its failure."""
        return {what: why for what, (why, backoff) in self._of.items() if now < backoff.until}

    def forget(self, what: str) -> None:
        """Forget the failures of one thing, because it has changed or has succeeded."""
        if self._of.pop(what, None) is not None:
            self._all = Backoff()

    def clear(self) -> None:
        """Forget all failures."""
        self._of.clear()
        self._all = Backoff()
