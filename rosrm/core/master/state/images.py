"""Known checkpoint images, and images to be removed."""

from __future__ import annotations

from dataclasses import dataclass, field

from rosrm.core.master.commands import OrderId
from rosrm.core.master.state.backoff import Backoff


@dataclass(slots=True)
class UnwantedImage:
    """An image that must be removed from its host.

    Attributes:
        process: name of its process.
        host: name of the host that stores it.
        drop: the executor that removes it.
        numbers: numbers of the dumped instance and of instances that restores of it created.
        order: order of the removal; None: no order awaits its answer.
        backoff: of the order to remove it.
    """

    process: str
    host: str
    drop: str
    numbers: tuple[int, ...]
    order: OrderId | None = None
    backoff: Backoff = field(default_factory=Backoff)


@dataclass(slots=True)
class Images:
    """All images that the master knows.

    Attributes:
        of: names of the checkpointed processes.
        unwanted: number of the dumped instance to its image.
    """

    of: set[str] = field(default_factory=set)
    unwanted: dict[int, UnwantedImage] = field(default_factory=dict)
