"""Fences: deadlines by which a host that is cut off from the master stops an instance.

A fence is a lease in the sense of Gray and Cheriton (1989), with one difference: the master need
not answer each host. Its beats name the silent hosts. A beat that does not name a host proves that
the master received a message from the host at most `suspect` seconds before. From that time the
host counts by its own boot clock. Clocks may differ, but must run equally fast.
"""

from __future__ import annotations

from math import inf
from typing import Final

from rosrm.core.master.settings import CoreSettings
from rosrm.model.values import Fence, ProcessSpec

#: Seconds for the transport of a beat, and for the clock reads of master and host.
_MARGIN: Final = 0.1
#: Share of the time until a successor may start that a process gets for a graceful stop.
_TO_END: Final = 0.25


def fence_of(spec: ProcessSpec, settings: CoreSettings) -> Fence | None:
    """Return the fence of an instance of a process; None: its host never stops it.

    Where a successor may start elsewhere after the loss of the host, the instance ends before that,
    unless its own `isolation.after` is longer. With `isolation: keep`, a process that may have a
    successor ends only if its slave does not run. In that case the host may still be connected, and
    other nodes would receive the messages of both instances.
    """
    follows = spec.host_loss.then == "elsewhere" or spec.standby.wanted
    stops = spec.isolation.then == "stop"
    graces = spec.stop.interrupt_grace + spec.stop.terminate_grace
    # A negative time would end each instance at its start, and so would NaN: `max` keeps the first
    # of two values that it cannot compare.
    own = max(0.0, spec.isolation.after)
    if not follows:
        return Fence(own or settings.lease, graces) if stops else None
    delay = 0.0 if spec.standby.wanted else spec.host_loss.delay
    until_successor = max(settings.lease + delay - settings.suspect - _MARGIN, _MARGIN)
    grace = min(graces, _TO_END * until_successor)
    after = own or until_successor - grace
    grace = min(graces, max(0.0, until_successor - after))
    return Fence(after, grace, alive=not stops)


def ended_after_loss(spec: ProcessSpec, settings: CoreSettings) -> float:
    """Return the seconds after the loss of a host by which the fence has ended every instance.

    inf: no fence, or a fence that does not end the instance while its slave runs.
    """
    fence = fence_of(spec, settings)
    if fence is None or fence.alive:
        return inf
    return settings.suspect + _MARGIN + fence.after + fence.grace - settings.lease
