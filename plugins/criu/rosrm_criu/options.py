"""Options of `criu`, and the capabilities that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Final

from rosrm import Bytes, Capabilities, PositiveSeconds, Seconds

#: Name under which strategy and launcher are selected.
NAME: Final = "criu"


@dataclass(frozen=True)
class CriuOptions:
    """Options for all processes or for one process.

    Attributes:
        start_timeout: seconds for a slave to accept a command or start a helper process, and for
            the destination to start.
        leave_timeout: seconds for the node to leave the ROS graph; a running callback of its
            author ends first.
        dump_timeout: seconds for the dump of its memory.
        transfer_timeout: seconds for the transfer of the image to the destination.
        restore_timeout: seconds for the restore there.
        join_timeout: seconds for the node to rejoin the ROS graph.
        max_rate: most bytes per second on the network for the image; 0: no bound. The default
            leaves part of a gigabit to others.
        reserve: bytes that must stay free on the image's file system at the destination.
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
        """Raise `ValueError` for a negative rate or reserve."""
        if self.max_rate < 0:
            raise ValueError(f"max_rate is {self.max_rate} bytes/s; allowed: 0 (no bound) or more")
        if self.reserve < 0:
            raise ValueError(f"reserve is {self.reserve} bytes; allowed: 0 or more")


@dataclass(frozen=True)
class OwnCriuOptions(CriuOptions):
    """Options for one process.

    Attributes:
        checkpoint_every: seconds from one periodic checkpoint to the next; 0: none. There is no
            such option for all processes, because each checkpoint freezes its process.
    """

    checkpoint_every: Seconds = 0.0

    def __post_init__(self) -> None:
        """Raise `ValueError` for an invalid option of all processes or an invalid period."""
        super().__post_init__()
        if not 0.0 <= self.checkpoint_every < inf:
            raise ValueError(
                f"checkpoint_every is {self.checkpoint_every:g} s; allowed: 0 (none) or more"
            )


@dataclass(frozen=True)
class HostCriuOptions:
    """Options of one host, in its own file.

    Attributes:
        as_root: a slave that runs as root takes images from other hosts. Each of these hosts can
            then run any program as root here.
    """

    as_root: bool = False


def capabilities(options: OwnCriuOptions) -> Capabilities:
    """Return the strategy's capabilities for a process with these options."""
    periodic = options.checkpoint_every > 0.0
    return Capabilities(state="memory", restart_from_image=periodic, launcher=NAME)
