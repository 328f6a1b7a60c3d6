"""Readiness and health of an instance, as a slave watches them."""

from __future__ import annotations

from dataclasses import dataclass

from rosrm.model.values import Health


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
    """Observation of an instance since the previous look.

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
    """Facts about an instance for a later run of this slave, which does not know its spec.

    Attributes:
        awaited: None: it is ready as soon as it runs.
        watch: None: its health is not watched.
    """

    awaited: Awaited | None = None
    watch: Watch | None = None
