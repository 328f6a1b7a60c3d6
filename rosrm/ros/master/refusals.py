"""Records of refused peers, at a rate that no sender can raise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, Literal

from rosrm import clocks
from rosrm.core.master import events as happened

#: Kind of a refused message. A sender chooses its own name, but not the kind.
Kind = Literal[
    "handoff", "handshake", "snapshot_reports", "master_beat", "other_host", "process_status",
    "process_usage", "resource_info", "stranger",
]  # fmt: skip
#: Takes the kind of a refused message, its sender and the reason.
Refuse = Callable[[Kind, str, str], None]

#: Seconds between two records of refusals of the same kind.
_RECORD_PERIOD: Final = 10.0


class Refusals:
    """Passes on one refusal of each kind in some seconds, with the number of the others."""

    def __init__(self, handle: Callable[[happened.Event], None]) -> None:
        self._handle = handle
        self._recorded: dict[Kind, tuple[float, int]] = {}

    def __call__(self, kind: Kind, who: str, reason: str) -> None:
        """Record a refusal, or count it if one of its kind was recorded a moment ago."""
        now = clocks.boot_time()
        recorded_at, others = self._recorded.get(kind, (-math.inf, 0))
        if now - recorded_at < _RECORD_PERIOD:
            self._recorded[kind] = (recorded_at, others + 1)
            return
        self._recorded[kind] = (now, 0)
        more = f" ({others} more of this kind since the last record)" if others else ""
        self._handle(happened.PeerRefused(who, f"{reason}{more}"))
