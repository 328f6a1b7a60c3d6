"""Options of `criu`, and what the strategy can do with them."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Final

from rosrm import Bytes, Capabilities, PositiveSeconds, Seconds

#: Name under which strategy and launcher are selected.
NAME: Final = "criu"


@dataclass(frozen=True)
class CriuOptions:
    """What can be set, for all processes or for one.

    Attributes:
        start_timeout: seconds within which a slave must take an order or start what it needs, and
            the destination start.
        leave_timeout: seconds within which the node must have left the ROS graph: a callback of its
            author is finished first.
        dump_timeout: seconds for dumping its memory.
        transfer_timeout: seconds for the image to get to the destination.
        restore_timeout: seconds for restoring it there.
        join_timeout: seconds within which the node must have joined the ROS graph again.
        max_rate: bytes a second that the image may take of the network; 0: all that there is. The
            default leaves something of a gigabit to others.
        reserve: bytes that stay free where the image goes to.
    """

    start_timeout: PositiveSeconds = 10.0
    leave_timeout: PositiveSeconds = 10.0
    dump_timeout: PositiveSeconds = 60.0
    transfer_timeout: PositiveSeconds = 120.0
    restore_timeout: PositiveSeconds = 60.0
    join_timeout: PositiveSeconds = 20.0
    max_rate: Bytes = 100_000_000
    reserve: Bytes = 256 << 20

    def __post_init__(self) -> None:
        """Refuse a rate that is none."""
        if self.max_rate < 0:
            raise ValueError(f"max_rate is {self.max_rate} bytes/s; allowed: 0 (no bound) or more")
        if self.reserve < 0:
            raise ValueError(f"reserve is {self.reserve} bytes; allowed: 0 or more")


@dataclass(frozen=True)
class OwnCriuOptions(CriuOptions):
    """What can be set for one process.

    Attributes:
        checkpoint_every: seconds from one periodic checkpoint to the next; 0: none. Not for all
            processes at once: each stands still for it.
    """

    checkpoint_every: Seconds = 0.0

    def __post_init__(self) -> None:
        """As those of all processes, and a pace that is one."""
        super().__post_init__()
        if not 0.0 <= self.checkpoint_every < inf:
            raise ValueError(
                f"checkpoint_every is {self.checkpoint_every:g} s; allowed: 0 (none) or more"
            )


def capabilities(options: OwnCriuOptions) -> Capabilities:
    """Return what the strategy can do for a process with these options."""
    periodic = options.checkpoint_every > 0.0
    return Capabilities(state="memory", restart_from_image=periodic, launcher=NAME)
