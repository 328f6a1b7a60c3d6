"""Events of the supervisor, in the past tense."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule


class StartOrdered(NamedTuple):
    """The client ordered a start.

    Attributes:
        fence: None: no deadline stops the instance, even without contact to the master.
        heard: last contact: newest time at which the master received from this host, as far as the
            client knows; None: just now.
    """

    instance: Key
    restart: RestartRule
    stop: StopRule
    fence: FenceRule | None = None
    heard: float | None = None


class StopOrdered(NamedTuple):
    """The client ordered the instance to end, without a restart."""

    instance: Key


class FenceOrdered(NamedTuple):
    """The client ordered all of the instance to end at once, because it has a successor."""

    instance: Key


class ContactReported(NamedTuple):
    """The client reported the last contact: the master received from this host at that time.

    Attributes:
        at: time of the last contact, by the monotonic clock.
        alive: newest time at which the client itself ran.
    """

    at: float
    alive: float = 0.0


class RestartOrdered(NamedTuple):
    """The client ordered a restart of the instance."""

    instance: Key


class AmendOrdered(NamedTuple):
    """The client set another restart policy for the instance."""

    instance: Key
    restart: RestartRule


class FailOrdered(NamedTuple):
    """The client found a run unhealthy: it counts as failed.

    Attributes:
        pid: of the unhealthy run; another run is left alone.
        reason: a text for listings and logs.
        kill: the run is stopped (SIGSTOP) and cannot handle SIGINT: SIGKILL at once.
    """

    instance: Key
    pid: int
    reason: str
    kill: bool = False


class StatusStored(NamedTuple):
    """The client has stored the final status: the supervisor need not keep it."""

    instance: Key


class Resumed(NamedTuple):
    """A restarted supervisor found a start that was ordered and never tried."""

    instance: Key


class Spawned(NamedTuple):
    """The session leader runs."""

    instance: Key
    pid: int


class SpawnFailed(NamedTuple):
    """The instance could not be started; `transient`: a retry may work."""

    instance: Key
    message: str
    transient: bool = False


class Exited(NamedTuple):
    """The session leader has ended.

    Attributes:
        code: exit code; UNKNOWN_EXIT: its end was not observed.
        signal: that killed it; 0: none.
        leftovers: other processes of its session still run.
    """

    instance: Key
    code: int = 0
    signal: int = 0
    peak_memory: float = 0.0
    cpu_time: float = 0.0
    leftovers: bool = False


class SessionEnded(NamedTuple):
    """The other processes of the session have ended too, after the session leader."""

    instance: Key


class FencePassed(NamedTuple):
    """Too much time has passed since the last contact with the master."""

    instance: Key


class TimePassed(NamedTuple):
    """A deadline may have been reached."""


class ShutdownOrdered(NamedTuple):
    """All instances are to end, and the supervisor with them."""


class ClientLost(NamedTuple):
    """The client is gone. The instances keep running, each as long as its fence allows."""


Event = (
    StartOrdered
    | StopOrdered
    | FenceOrdered
    | ContactReported
    | RestartOrdered
    | AmendOrdered
    | FailOrdered
    | StatusStored
    | Resumed
    | Spawned
    | SpawnFailed
    | Exited
    | SessionEnded
    | FencePassed
    | TimePassed
    | ShutdownOrdered
    | ClientLost
)
