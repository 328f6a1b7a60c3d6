"""The checkpoint images that the master knows, and those that are to be removed."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Unwanted:
    """An image that is to be removed.

    Attributes:
        process: that it was of.
        host: name of the host on which it lies.
        drop: the executor that removes it.
        numbers: of the instances that it is of, or that were to be restored from it.
        order: by which that is asked for; 0: it is not.
        ask_at: when it is asked for (again).
    """

    process: str
    host: str
    drop: str
    numbers: tuple[int, ...]
    order: int = 0
    ask_at: float = float("-inf")


@dataclass(slots=True)
class Images:
    """What the master knows of images.

    Attributes:
        of: names of the processes that are checkpointed.
        unwanted: by the number of the instance.
    """

    of: set[str] = field(default_factory=set)
    unwanted: dict[int, Unwanted] = field(default_factory=dict)
