"""Requester: the sender of a request to the master, and its rights on processes."""

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


#: Operator without a name, for simulations, and for recordings without names of requesters.
OPERATOR: Final = Requester(is_operator=True)
