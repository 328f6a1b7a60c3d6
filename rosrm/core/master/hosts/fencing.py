"""When a host that is cut off from the master stops an instance by itself.

A lease in the sense of Gray and Cheriton (1989), with one difference: the master need not answer
each host. It names in its beats those that it does not hear, so that a beat which does not name a
host tells it that it was heard at most `suspect` seconds before. From there the host counts by its
own monotonic clock; clocks may differ, if only they run equally fast.
"""

from __future__ import annotations

from math import inf
from typing import Final

from rosrm.core.master.settings import CoreSettings
from rosrm.model.values import Fence, ProcessSpec

#: Seconds for a beat on its way, and for the master and the host to look at their clocks.
_MARGIN: Final = 0.1
#: Part of the time until a successor may start that a process is given to end by itself.
_TO_END: Final = 0.25


def fence_of(spec: ProcessSpec, settings: CoreSettings) -> Fence | None:
    """When its host stops an instance of a process; None: never.

    Where a successor may start elsewhere when its host is lost, it has ended before that, unless
    its own `isolation.after` is longer. One that is to go on while its host is cut off
    (`isolation: keep`) ends only when its slave is not at work: then it is the host alone that says
    nothing, and both would be heard by others.
    """
    follows = spec.host_loss.then == "elsewhere" or spec.standby.wanted
    stops = spec.isolation.then == "stop"
    graces = spec.stop.interrupt_grace + spec.stop.terminate_grace
    if not follows:
        return Fence(spec.isolation.after or settings.lease, graces) if stops else None
    delay = 0.0 if spec.standby.wanted else spec.host_loss.delay
    until_successor = max(settings.lease + delay - settings.suspect - _MARGIN, _MARGIN)
    grace = min(graces, _TO_END * until_successor)
    after = spec.isolation.after or until_successor - grace
    grace = min(graces, max(0.0, until_successor - after))
    return Fence(after, grace, alive=not stops)


def ended_after_loss(spec: ProcessSpec, settings: CoreSettings) -> float:
    """Return the seconds after a host is lost by which its fence has ended every instance.

    inf: the fence may not end the instance at all, because a slave that is at work keeps it.
    """
    fence = fence_of(spec, settings)
    if fence is None or fence.alive:
        return inf
    return settings.suspect + _MARGIN + fence.after + fence.grace - settings.lease
