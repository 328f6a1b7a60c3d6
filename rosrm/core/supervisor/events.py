"""Events of the supervisor, in the past tense."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule


class StartOrdered(NamedTuple):
    """The client wants it to run.

    Attributes:
        fence: None: it is not stopped by the clock, whatever the client hears.
        heard: when the master last heard this host, as far as the client knows; None: just now.
    """

    instance: Key
    restart: RestartRule
    stop: StopRule
    fence: FenceRule | None = None
    heard: float | None = None


class StopOrdered(NamedTuple):
    """The client wants it to end, and not to be restarted."""

    instance: Key


class FenceOrdered(NamedTuple):
    """The client wants all of it to be gone at once: it has a successor."""

    instance: Key


class Heard(NamedTuple):
    """The client knows that the master heard this host `at` that time, by the monotonic clock.

    Attributes:
        alive: newest time at which the client itself was at work.
    """

    at: float
    alive: float = 0.0


class RestartOrdered(NamedTuple):
    """The client wants it stopped and started again."""

    instance: Key


class AmendOrdered(NamedTuple):
    """The client wants another restart policy for it from now on."""

    instance: Key
    restart: RestartRule


class FailOrdered(NamedTuple):
    """The client has found that a run of it is not what it should be: it counts as failed.

    Attributes:
        pid: of the run that is meant; another one is left alone.
        reason: for people.
        kill: it is stopped (SIGSTOP) and cannot end in good order: SIGKILL at once.
    """

    instance: Key
    pid: int
    reason: str
    kill: bool = False


class Forgotten(NamedTuple):
    """The client has kept its final status: this side need not."""

    instance: Key


class Resumed(NamedTuple):
    """A restarted supervisor found that its start was ordered and never tried."""

    instance: Key


class Spawned(NamedTuple):
    """Its session leader runs."""

    instance: Key
    pid: int


class SpawnFailed(NamedTuple):
    """It could not be started; `transient`: the same may work later."""

    instance: Key
    message: str
    transient: bool = False


class Exited(NamedTuple):
    """Its session leader is no more.

    Attributes:
        code: exit code; UNKNOWN_EXIT: nobody saw it end.
        signal: that killed it; 0: none.
        leftovers: other processes of its session live on.
    """

    instance: Key
    code: int = 0
    signal: int = 0
    peak_memory: float = 0.0
    cpu_time: float = 0.0
    leftovers: bool = False


class Cleared(NamedTuple):
    """Its session leader was gone already, and now the others are."""

    instance: Key


class FencePassed(NamedTuple):
    """For too long it was not known that the master hears this host."""

    instance: Key


class TimePassed(NamedTuple):
    """A deadline may have been reached."""


class ShutdownOrdered(NamedTuple):
    """Everything is to end, and the supervisor with it."""


class ClientLost(NamedTuple):
    """Nobody listens. The instances keep running, each as long as its fence allows."""


Event = (
    StartOrdered
    | StopOrdered
    | FenceOrdered
    | Heard
    | RestartOrdered
    | AmendOrdered
    | FailOrdered
    | Forgotten
    | Resumed
    | Spawned
    | SpawnFailed
    | Exited
    | Cleared
    | FencePassed
    | TimePassed
    | ShutdownOrdered
    | ClientLost
)
