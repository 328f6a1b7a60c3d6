"""Steps of an instance on its way to readiness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rosrm.core.slave import commands


@dataclass(frozen=True, slots=True)
class Step:
    """Result of an event for an instance on the way to its goal.

    Attributes:
        commands: requests to its node.
        reached: the instance has reached its goal.
        fault: why it cannot reach its goal; "": it can.
    """

    commands: tuple[commands.Command, ...] = ()
    reached: bool = False
    fault: str = ""


NOTHING: Final = Step()
