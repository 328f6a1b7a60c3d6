"""Numbers in the results of executors, which are JSON objects of plugins with any contents."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import Any, Final

from rosrm.wording import sanitized

#: Upper bound of a number, because JSON may hold integers that no float can.
_MOST: Final = 1e18
#: Maximum number of durations in a result, and of characters of a name, because one listing has the
#: events of a day.
_MOST_PARTS: Final = 32
_LONGEST_NAME: Final = 64


def number_of(value: Any) -> float:
    """Return a number of a result; 0.0 for anything else, NaN and infinity too."""
    return float(value) if isinstance(value, int | float) and 0 <= value < _MOST else 0.0


def seconds_of(result: Mapping[str, Any]) -> dict[str, float]:
    """Return the durations of an executor's parts, by name, for the facts of an event."""
    parts = result.get("seconds")
    pairs = islice(parts.items(), _MOST_PARTS) if isinstance(parts, Mapping) else ()
    return {sanitized(name, _LONGEST_NAME): number_of(value) for name, value in pairs}
