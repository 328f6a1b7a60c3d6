"""Estimate of the send times of the master's beats, by the slave's clock."""

from __future__ import annotations

from typing import Final

#: Seconds by which a beat may be faster than the fastest one before it. The first one is in the
#: answer to a handshake, which takes at most a few seconds.
_FASTER: Final = 10.0
#: Share by which one boot clock may run faster than another: twice the limit of `adjtimex`.
_DRIFT: Final = 1e-3


class BeatClock:
    """Estimator of the send time of beats, which recognizes beats that waited in a socket.

    A slave that was stopped (SIGSTOP) finds old beats in its sockets. They name the silent hosts at
    their send time, not now. The boot clocks of two machines share only their rate. So the
    fastest beat since the handshake gives the difference of the clocks. A beat with a longer
    transport was sent earlier by the additional time. The estimate is late only by the transport
    time of the fastest beat.
    """

    def __init__(self) -> None:
        self._ahead: float | None = None
        self._noted_at = 0.0

    def restart(self) -> None:
        """Forget the difference of the clocks, because a new master may have another clock."""
        self._ahead = None

    def is_ahead(self, beat: float, now: float) -> bool:
        """Return True for a beat that the master cannot have sent yet: another has sent it.

        Such a beat would make all later beats look old, and the fences would stop the processes.
        """
        return self._ahead is not None and now - beat < self._ahead - _FASTER

    def sent_at(self, beat: float, now: float) -> float:
        """Return the send time of a beat by the slave's clock, in seconds.

        Args:
            beat: send time by the master's clock.
            now: time of arrival by the slave's clock.
        """
        ahead = now - beat
        if self._ahead is not None:
            ahead = min(ahead, self._ahead + _DRIFT * (now - self._noted_at))
        self._ahead, self._noted_at = ahead, now
        return beat + ahead
