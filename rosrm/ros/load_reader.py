"""Reader of the load that the master publishes once a second, for clients."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from rosrm import clocks
from rosrm.keys.security import Member
from rosrm.ros import qos
from rosrm.ros.sealed import SealedEndpoints
from rosrm_msgs import msg

#: Seconds for which the figures of a message count, and after which the subscription is replaced.
_FRESH: Final = 5.0
_SILENCE: Final = 15.0
#: Figures that are numbers; docs/reference/protocol.md has their meanings.
_NUMBERS: Final = (
    "hosts", "cycles", "missed", "dropped", "strangers", "cpu_s", "turn_s", "write_s", "decide_s",
    "decisions", "deciding_s",
)  # fmt: skip


class LoadReader:
    """Follows `master_load`.

    A subscription that was made while the process could open no further file may be silent for
    ever. So a silent one is replaced.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Member], topic: str,
        clock: Callable[[], float] = clocks.boot_time,
    ) -> None:  # fmt: skip
        self._endpoints, self._topic, self._clock = endpoints, topic, clock
        self._newest: Mapping[str, float] = {}
        self._follow()

    def newest(self) -> Mapping[str, float]:
        """Return the figures of the newest message; empty: none came in the last seconds."""
        silence = self._clock() - self._at
        if silence > _SILENCE:
            self._endpoints.participant.node.destroy_subscription(self._subscription)
            self._follow()
        return self._newest if silence <= _FRESH else {}

    def _follow(self) -> None:
        self._at = self._clock()
        self._newest = {}
        self._subscription = self._endpoints.follow(msg.Event, self._topic, qos.LOAD, self._take)

    def _take(self, message: msg.Event, _run: bytes) -> None:
        self._newest, self._at = figures(json.loads(message.data)), self._clock()


def figures(data: Mapping[str, Any]) -> Mapping[str, float]:
    """Return the figures of a message, without those that are no numbers."""
    ages = [age for age in data.get("oldest_reading_s", ()) if _is_number(age)]
    found = {name: data[name] for name in _NUMBERS if _is_number(data.get(name))}
    return {**found, "oldest_reading_s": max(ages, default=0.0)}


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)
