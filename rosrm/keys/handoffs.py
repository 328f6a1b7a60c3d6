"""Keys of handoffs: one for each instance, and one for each handoff between two of them.

The slave gives the key of an instance to its node, and the master derives the same key. The master
sends the key of a handoff to its two nodes, to each under the key of its instance. The nodes seal
their messages to each other under the key of the handoff.
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
        key: of an instance or a handoff; None: with `security: none`.
        outward: direction of the messages that the link seals.
        inward: direction of the messages that it opens.
    """
    run = os.urandom(RUN_BYTES)
    return OpenLink(run) if key is None else KeyedLink(key, run, outward, inward)


@dataclass(frozen=True, slots=True)
class HandoffKeys:
    """The keys that the master derives for handoffs.

    Args:
        _secret: returns that of the cluster, which an operator may replace.
        _host_key: returns the key of the host that runs an instance, given by process and number;
            None: the instance is unknown.
    """

    _secret: Callable[[], bytes]
    _host_key: Callable[[str, int], bytes | None]

    def of_instance(self, process: str, number: int) -> bytes | None:
        """Return the key of an instance; None: it has none."""
        host_key = self._host_key(process, number)
        return None if host_key is None else instance_key(host_key, process, number)

    def of_handoff(self, process: str, destination: int) -> bytes:
        """Return the key of a handoff, which the number of its destination identifies."""
        return derived(self._secret(), "handoff", process, destination)
