"""Bound of all times that rosrm waits."""

from __future__ import annotations

from typing import Final

#: Most seconds of any delay, grace, time-out or run: ten years. Longer ones overflow timers of the
#: kernel, e.g. that of `epoll`.
LONGEST: Final = 10 * 365.25 * 86400.0
