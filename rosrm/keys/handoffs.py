"""Keys of handoffs: one for each instance, and one for each handoff between two of them.

The slave puts the key of an instance into the environment of its node, and the master derives the
same key. The master sends the key of a handoff to both nodes, sealed with the keys of their
instances. The nodes seal their messages to each other with the key of the handoff.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

from rosrm.keys.derivation import derived
from rosrm.keys.links import KeyedLink, Link, OpenLink
from rosrm.keys.sealing import RUN_BYTES, Direction


def instance_key(host_key: bytes, process: str, number: int) -> bytes:
    """Return the key of an instance, from the key of the host that runs it."""
    return derived(host_key, "instance", process, number)


def new_link(key: bytes | None, outward: Direction, inward: Direction) -> Link:
    """Return a link with a new run, whose counters begin at 1.

    Args:
        key: key of a ticket, an instance or a handoff; None with `security: none`.
        outward: direction of the messages that the link seals.
        inward: direction of the messages that it opens.
    """
    run = os.urandom(RUN_BYTES)
    return OpenLink(run) if key is None else KeyedLink(key, run, outward, inward)


@dataclass(frozen=True, slots=True)
class HandoffKeys:
    """The keys that the master derives for handoffs.

    Args:
        _secret: returns the cluster's secret, which `rosrm key rotate` may replace at any time.
        _host_key: returns the key of the host that runs an instance, given by process and number;
            None if the instance is unknown.
    """

    _secret: Callable[[], bytes]
    _host_key: Callable[[str, int], bytes | None]

    def of_instance(self, process: str, number: int) -> bytes | None:
        """Return the key of an instance; None if the instance is unknown."""
        host_key = self._host_key(process, number)
        return None if host_key is None else instance_key(host_key, process, number)

    def of_handoff(self, process: str, destination: int) -> bytes:
        """Return the key of a handoff, which the number of its destination identifies."""
        return derived(self._secret(), "handoff", process, destination)
