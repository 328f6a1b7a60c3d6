"""Readiness and health of an instance, as a slave watches them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rosrm.model.values import Health


class NoState(Enum):
    """Reason why the lifecycle state of a node is not known."""

    NOT_YET = "the node has not been asked, or may still answer"
    NO_ANSWER = "the node does not answer"


@dataclass(frozen=True, slots=True)
class Awaited:
    """Readiness of an instance that must be seen in the ROS graph.

    Attributes:
        node_name: fully qualified name of its node.
        timeout: seconds that each of its runs has for it.
        seen: pid of the run that was seen; 0: none was.
    """

    node_name: str
    timeout: float
    seen: int = 0


@dataclass(frozen=True, slots=True)
class Watch:
    """Health checks of an instance that is ready.

    Attributes:
        checks: as its spec declares.
        topics: absolute names, on one of which it must publish; (): none.
        services: absolute names under which its lifecycle state is queried; (): it is not.
        restarts: its slave restarts it, unless a migration is under way.
        paused: it is not watched for now: it is a shadow, or is being moved and may be silent.
    """

    checks: Health
    topics: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    restarts: bool = True
    paused: bool = False


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of an instance since the previous look.

    Attributes:
        stopped: a signal has stopped its session leader.
        messages: messages on its topic; None: the topic cannot be received.
        trouble: why the topic cannot be received; "": it can.
        state: label of its lifecycle state, or the reason why there is none.
    """

    stopped: bool = False
    messages: int | None = None
    trouble: str = ""
    state: str | NoState = NoState.NOT_YET


@dataclass(frozen=True, slots=True)
class Memo:
    """Facts about an instance for a later run of this slave, which does not know its spec.

    Attributes:
        awaited: None: it is ready as soon as it runs.
        watch: None: its health is not watched.
    """

    awaited: Awaited | None = None
    watch: Watch | None = None
