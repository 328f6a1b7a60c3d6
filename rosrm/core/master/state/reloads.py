"""State of a reload: the request, and the answers of the slaves so far."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Reloads:
    """The reload under way.

    Attributes:
        request: number of the request; 0: no reload is under way.
        awaited: names of the hosts whose slaves have not answered yet.
        lines: outcomes, one for each part.
        refused: True if a slave has refused its file.
    """

    request: int = 0
    awaited: set[str] = field(default_factory=set)
    lines: list[str] = field(default_factory=list)
    refused: bool = False
