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
        incarnation: incarnation of the slave that received the order.
        order: order of the check; None: it was not sent.
        facts: result of the check; None: no answer yet, or the strategy does not work there.
        reason: why the strategy does not work there.
        ask_at: time at which the check is repeated; inf: never.
    """

    incarnation: int
    order: OrderId | None = None
    facts: Mapping[str, str] | None = None
    reason: str = ""
    ask_at: float = inf
