"""What each host answered about each strategy that does not work on every host."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Final

#: Numbers of the orders are apart from those of all else: a record that is replayed without a
#: strategy must not number its orders otherwise.
BEFORE_FIRST: Final = 1 << 41


@dataclass(slots=True)
class Answer:
    """What one host says of one strategy.

    Attributes:
        incarnation: of the slave that was asked.
        order: by which it was asked.
        facts: None: it has not answered, or the strategy does not work there.
        reason: why it does not.
        ask_at: when it is asked again; inf: there is no need.
    """

    incarnation: int
    order: int
    facts: Mapping[str, str] | None = None
    reason: str = ""
    ask_at: float = inf


@dataclass(slots=True)
class Abilities:
    """What all hosts say of all strategies that are not for every host.

    Attributes:
        answers: by strategy and host.
        last_order: by which a host was asked.
    """

    answers: dict[tuple[str, str], Answer] = field(default_factory=dict)
    last_order: int = BEFORE_FIRST
