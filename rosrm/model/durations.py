"""Bounds of all times that rosrm waits."""

from __future__ import annotations

from typing import Final

#: Most seconds of any delay, grace, time-out or run: ten years. Longer ones overflow timers of the
#: kernel, e.g. that of `epoll`.
LONGEST: Final = 10 * 365.25 * 86400.0
#: Maximum time, in seconds, from the order to stop a process to SIGKILL, so that every stop ends:
#: that of a host's slave, that of a process which an operator cancels, and that of systemd's unit.
LONGEST_STOP: Final = 600.0
