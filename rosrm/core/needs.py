"""What a process will use: as declared, else as learned from earlier runs, else a default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rosrm.core.model import ProcessSpec

#: Weight of the newest run: a program that changed is known again after a few runs.
_NEWEST = 0.3


@dataclass(frozen=True, slots=True)
class Estimate:
    """Needs in base units, and which of them are mere estimates."""

    amounts: Mapping[str, float]
    estimated: frozenset[str]


class LearnedNeeds:
    """Peaks of earlier runs by program, as a moving mean."""

    def __init__(self) -> None:
        self._known: dict[str, dict[str, float]] = {}

    def restore(self, program: str, amounts: Mapping[str, float]) -> None:
        """Take over what an earlier run of the master learned."""
        self._known[program] = dict(amounts)

    def learn(self, program: str, amounts: Mapping[str, float]) -> Mapping[str, float]:
        """Take in one run's peaks; returns what is known now."""
        known = self._known.setdefault(program, {})
        for resource, amount in amounts.items():
            if amount > 0.0:
                before = known.get(resource, amount)
                known[resource] = before + _NEWEST * (amount - before)
        return dict(known)

    def estimate(self, spec: ProcessSpec, default: Mapping[str, float]) -> Estimate:
        """What to count against a host for one instance of a process."""
        guessed = {**default, **self._known.get(spec.program, {})}
        amounts = {**guessed, **spec.needs}
        return Estimate(amounts, frozenset(guessed) - frozenset(spec.needs))
