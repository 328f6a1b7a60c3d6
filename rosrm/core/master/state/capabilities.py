"""Capability of a host: its answer about a strategy that does not work on every host."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

from rosrm.core.master.commands import OrderId


@dataclass(slots=True)
class Answer:
    """The answer of one host about one strategy.

    Attributes:
        incarnation: of the slave that was asked.
        order: by which it was asked; None: it was not.
        facts: None: it has not answered, or the strategy does not work there.
        reason: why the strategy does not work there.
        ask_at: time at which it is asked again; inf: never.
    """

    incarnation: int
    order: OrderId | None = None
    facts: Mapping[str, str] | None = None
    reason: str = ""
    ask_at: float = inf
