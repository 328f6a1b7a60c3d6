"""When a beat of the master was said, by the clock of the slave."""

from __future__ import annotations

from typing import Final

#: Part by which one monotonic clock may run faster than another: twice what `adjtimex` allows.
_DRIFT: Final = 1e-3


class BeatClock:
    """Tells a beat that has waited for somebody to take it in from one that comes at once.

    A slave that was stopped (SIGSTOP) finds old beats in its sockets: they say who was heard then,
    not who is heard now. The clocks of two machines have nothing in common but their pace, so the
    beat that was quickest on its way since the handshake gives the difference; a later one that
    took longer was said so much earlier. The result is too new by the time of the quickest alone.
    """

    def __init__(self) -> None:
        self._ahead: float | None = None
        self._noted_at = 0.0

    def restart(self) -> None:
        """Another run of a master, or one that was away: its clock may be another."""
        self._ahead = None

    def said_at(self, beat: float, now: float) -> float:
        """When it was said, if it arrives `now`; seconds both, by the master's clock and ours."""
        ahead = now - beat
        if self._ahead is not None:
            ahead = min(ahead, self._ahead + _DRIFT * (now - self._noted_at))
        self._ahead, self._noted_at = ahead, now
        return beat + ahead
