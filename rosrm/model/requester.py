"""Requester: who sends a request to the master, and on which processes it may act."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Requester:
    """Sender of a request.

    Attributes:
        name: text of the principal, "user:ada"; "": unknown.
        is_operator: the requester may act on every process.
    """

    name: str = ""
    is_operator: bool = False

    def may_act_on(self, owner: str) -> bool:
        """Return True if the requester may act on the processes of an owner; "": unknown owner."""
        return self.is_operator or (self.name != "" and self.name == owner)


#: Operator without a name: requests in simulations, and in recordings that do not name one.
OPERATOR: Final = Requester(is_operator=True)
