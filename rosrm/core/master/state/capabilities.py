"""Capabilities: the answer of each host about each strategy that does not work on all hosts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Final

#: These orders have numbers of their own, because a recording that is replayed without a strategy
#: must give the other orders the same numbers.
BEFORE_FIRST: Final = 1 << 41


@dataclass(slots=True)
class Answer:
    """The answer of one host about one strategy.

    Attributes:
        incarnation: of the slave that was asked.
        order: by which it was asked.
        facts: None: it has not answered, or the strategy does not work there.
        reason: why the strategy does not work there.
        ask_at: time at which it is asked again; inf: never.
    """

    incarnation: int
    order: int
    facts: Mapping[str, str] | None = None
    reason: str = ""
    ask_at: float = inf


@dataclass(slots=True)
class Abilities:
    """The capabilities of all hosts, for all strategies that do not work on every host.

    Attributes:
        answers: by strategy and host.
        last_order: by which a host was asked.
    """

    answers: dict[tuple[str, str], Answer] = field(default_factory=dict)
    last_order: int = BEFORE_FIRST
