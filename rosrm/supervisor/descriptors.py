"""Limit of open descriptors: as high as allowed for the supervisor, unchanged for its processes.

The supervisor has a descriptor for each process that it has taken over. Programs that use `select`
fail with descriptors above 1023, so processes get the limit that the supervisor was started with.
"""

from __future__ import annotations

import resource
from typing import Final

#: Descriptors that no watched process takes: for /proc, logs, the record and connections.
RESERVE: Final = 100


def raise_limit() -> int:
    """Raise the soft limit of this process to the hard limit; return the former soft limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return soft


def most_watched() -> int:
    """Return the number of descriptors that may be in use for watched processes."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0] - RESERVE


def lower_limit(soft: int) -> None:
    """Give this process, which becomes a program, a soft limit: never the supervisor itself.

    The supervisor may have more open files than that, and could open no other one.
    """
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, hard), hard))
