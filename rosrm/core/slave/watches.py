"""What a slave watches of an instance: its readiness and its health."""

from __future__ import annotations

from dataclasses import dataclass

from rosrm.model.values import Health


@dataclass(frozen=True, slots=True)
class Awaited:
    """How an instance becomes ready by being seen in the ROS graph.

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
    """What is watched of the health of an instance that is ready.

    Attributes:
        wanted: by its spec.
        topics: absolute names of what it must publish, one of them; (): nothing.
        services: absolute names under which its lifecycle state is asked; (): it is not.
        restarts: its slave starts it again, unless a move is under way.
        paused: it is not watched for now: it is a shadow, or is being moved and may be silent.
    """

    wanted: Health
    topics: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    restarts: bool = True
    paused: bool = False


@dataclass(frozen=True, slots=True)
class Look:
    """What was seen of an instance since the look before.

    Attributes:
        stopped: its session leader is, by a signal.
        heard: messages on its topic; None: it cannot be listened to.
        trouble: why it cannot; "": it can.
        state: of its lifecycle; "": it does not answer; None: that is not known yet.
    """

    stopped: bool = False
    heard: int | None = None
    trouble: str = ""
    state: str | None = None


@dataclass(frozen=True, slots=True)
class Memo:
    """What a later run of this slave must know of an instance; its spec it does not know.

    Attributes:
        awaited: None: it is ready as soon as it runs.
        watch: None: its health is not watched.
    """

    awaited: Awaited | None = None
    watch: Watch | None = None
