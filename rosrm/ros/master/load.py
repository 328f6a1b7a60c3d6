"""Load of the master: durations of its work since the last message about it, and totals."""

from __future__ import annotations

import time


class MasterLoad:
    """Figures of the master's load. docs/reference/protocol.md has their meanings."""

    def __init__(self) -> None:
        self._longest: dict[str, float] = {}
        self._decisions = 0
        self._deciding = 0.0

    def note_turn(self, seconds: float) -> None:
        """Note the duration of a turn of the loop."""
        self._note("turn_s", seconds)

    def note_write(self, seconds: float) -> None:
        """Note the duration of a write of the journal."""
        self._note("write_s", seconds)

    def note_decision(self, seconds: float) -> None:
        """Note the time between an event and the commands that the core derives from it."""
        self._note("decide_s", seconds)
        self._decisions += 1
        self._deciding += seconds

    def _note(self, name: str, seconds: float) -> None:
        self._longest[name] = max(self._longest.get(name, 0.0), seconds)

    def take(self) -> dict[str, float]:
        """Return the figures; the longest durations begin again."""
        longest, self._longest = self._longest, {}
        return {
            "cpu_s": time.process_time(),
            **{
                name: round(longest.get(name, 0.0), 6) for name in ("turn_s", "write_s", "decide_s")
            },
            "decisions": self._decisions,
            "deciding_s": round(self._deciding, 6),
        }
