"""Needs of a process: as declared, else as learned from earlier runs, else a default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from rosrm.core.newest import Newest
from rosrm.model.values import EMPTY, ProcessSpec

#: Highest number of programs whose runs are remembered. The text of a command is a program, so each
#: job of a sweep over parameters may be another one.
MOST_PROGRAMS: Final = 10_000
#: Weight of the newest run: the mean follows a changed program within a few runs.
_NEWEST: Final = 0.3
#: The learned amount follows the mean only if they differ by this share. Otherwise each end of a
#: run would change the demands of equal waiting processes, and write to the journal.
_NOTICEABLE: Final = 0.1


@dataclass(frozen=True, slots=True)
class Estimate:
    """Needs in base units by resource, and the resources whose amount is not declared."""

    amounts: Mapping[str, float]
    estimated: frozenset[str] = frozenset()


NO_NEEDS: Final = Estimate(EMPTY)


class LearnedNeeds:
    """Peaks of earlier runs by program, as a moving mean.

    Attributes:
        version: counter of changes of learned amounts.
    """

    def __init__(self) -> None:
        self.version = 0
        self._counts = Newest[str, dict[str, float]](MOST_PROGRAMS)
        self._mean = Newest[str, dict[str, float]](MOST_PROGRAMS)

    def restore(self, program: str, amounts: Mapping[str, float]) -> None:
        """Restore the learned needs of a program from the journal."""
        self._counts.put(program, dict(amounts))
        self._mean.put(program, dict(amounts))

    def learn(
        self, program: str, amounts: Mapping[str, float], *, may_lower: bool = True
    ) -> dict[str, Mapping[str, float] | None]:
        """Learn the peaks of one run; return the changed needs by program, None: forgotten.

        `may_lower`: False: a smaller peak than the known one shows nothing.
        """
        mean = self._mean.get(program, {})
        counts = self._counts.get(program, {})
        changed: dict[str, Mapping[str, float] | None] = {}
        self._mean.put(program, mean)
        if (forgotten := self._counts.put(program, counts)) is not None:
            changed[forgotten] = None
        for resource, amount in amounts.items():
            if amount > 0.0:
                before = mean.get(resource, amount)
                if amount < before and not may_lower:
                    continue
                mean[resource] = before + _NEWEST * (amount - before)
                counted = counts.get(resource, 0.0)
                if abs(mean[resource] - counted) > _NOTICEABLE * counted:
                    counts[resource] = mean[resource]
                    changed[program] = counts
        self.version += bool(changed)
        return changed

    def estimate(self, spec: ProcessSpec, default: Mapping[str, float]) -> Estimate:
        """Return the needs of one instance of a process."""
        guessed = {**default, **self._counts.get(spec.program, {})}
        amounts = {**guessed, **spec.needs}
        return Estimate(amounts, frozenset(guessed) - frozenset(spec.needs))
