"""Reader of the load that the master publishes once a second, for clients."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final

from rosrm.keys.security import Member
from rosrm.ros import qos
from rosrm.ros.sealed import SealedEndpoints
from rosrm_msgs import msg

#: Figures that are numbers; docs/reference/protocol.md has their meanings.
_NUMBERS: Final = (
    "hosts", "cycles", "missed", "dropped", "strangers", "cpu_s", "turn_s", "write_s", "decide_s",
    "decisions", "deciding_s",
)  # fmt: skip


class LoadReader:
    """Follows `master_load`.

    Attributes:
        newest: figures of the newest message, with the oldest of its readings; empty: none came.
    """

    def __init__(self, endpoints: SealedEndpoints[Member], topic: str) -> None:
        self.newest: Mapping[str, float] = {}
        endpoints.follow(msg.Event, topic, qos.LOAD, self._take)

    def _take(self, message: msg.Event, _run: bytes) -> None:
        self.newest = figures(json.loads(message.data))


def figures(data: Mapping[str, Any]) -> Mapping[str, float]:
    """Return the figures of a message, without those that are no numbers."""
    ages = [age for age in data.get("oldest_reading_s", ()) if _is_number(age)]
    found = {name: data[name] for name in _NUMBERS if _is_number(data.get(name))}
    return {**found, "oldest_reading_s": max(ages, default=0.0)}


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)
