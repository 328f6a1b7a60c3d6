"""Section `rollout` of a work file: the way in which changed processes are replaced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from rosrm.extensions.units import PositiveCount, Seconds
from rosrm.model.applications import OnFailure, RolloutPolicy

_DEFAULT: Final = RolloutPolicy()


@dataclass(frozen=True, slots=True)
class RolloutInFile:
    """Keys of the section; see `RolloutPolicy`."""

    EXAMPLES: ClassVar[Mapping[str, Sequence[str]]] = {"": ("{healthy_for: 3s}",)}

    max_parallel: PositiveCount = _DEFAULT.max_parallel
    healthy_for: Seconds = _DEFAULT.healthy_for
    on_failure: OnFailure = _DEFAULT.on_failure

    def policy(self) -> RolloutPolicy:
        """Return the policy that the section describes."""
        return RolloutPolicy(self.max_parallel, self.healthy_for, self.on_failure)
