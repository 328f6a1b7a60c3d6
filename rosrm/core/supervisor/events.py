"""Events of the supervisor, in the past tense."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule


class StartOrdered(NamedTuple):
    """The client ordered a start.

    Attributes:
        fence: None: no deadline stops the instance, even without contact to the master.
        heard: last contact: newest time known to the client at which the master received a message
            of this host; None: now.
        slots: start once fewer than this number of other instances are active, that is, neither
            held nor ended; 0: start at once.
    """

    instance: Key
    restart: RestartRule
    stop: StopRule
    fence: FenceRule | None = None
    heard: float | None = None
    slots: int = 0


class StopOrdered(NamedTuple):
    """The client ordered to stop the instance for good."""

    instance: Key


class FenceOrdered(NamedTuple):
    """The client ordered to kill the instance, because it has a successor."""

    instance: Key


class ContactReported(NamedTuple):
    """The client reported the time at which the master last received a message of this host.

    Attributes:
        at: time of the last contact, by the boot clock.
        alive: newest time at which the client itself ran.
    """

    at: float
    alive: float = 0.0


class RestartOrdered(NamedTuple):
    """The client ordered a restart of the instance.

    Attributes:
        run: pid (0: none) and number of restarts of the run that is to end; another run is not
            changed; None: any run.
    """

    instance: Key
    run: tuple[int, int] | None = None


class AmendOrdered(NamedTuple):
    """The client set another restart policy for the instance, and perhaps other limits.

    Attributes:
        held: names of the limits that hold from now on; None: those that held before.
    """

    instance: Key
    restart: RestartRule
    held: tuple[str, ...] | None = None


class FailOrdered(NamedTuple):
    """The client found a run unhealthy: it counts as failed.

    Attributes:
        pid: pid of the unhealthy run; another run is not changed.
        reason: text for listings and logs.
        kill: send SIGKILL at once, because SIGSTOP has stopped the run, so it cannot handle SIGINT.
    """

    instance: Key
    pid: int
    reason: str
    kill: bool = False


class StatusStored(NamedTuple):
    """The client has stored the final status, so the supervisor may drop it."""

    instance: Key


class SlotFreed(NamedTuple):
    """A held instance may start, because another one has ended."""

    instance: Key


class Resumed(NamedTuple):
    """A restarted supervisor found a start that was ordered and has not begun."""

    instance: Key


class Spawned(NamedTuple):
    """The session leader runs.

    Attributes:
        enforced: names of its limits and scheduling settings that hold.
        note: text on limits that do not hold.
        adopted: it ran before, and was not started by this order.
        unfound: sentence on files of its command that did not exist at its start; "": none.
    """

    instance: Key
    pid: int
    enforced: tuple[str, ...] = ()
    note: str = ""
    adopted: bool = False
    unfound: str = ""


class SpawnFailed(NamedTuple):
    """The instance could not be started; `transient`: a retry may succeed."""

    instance: Key
    message: str
    transient: bool = False


class Exited(NamedTuple):
    """The session leader has ended.

    Attributes:
        code: exit code; UNKNOWN_EXIT: the end was not observed.
        signal: signal that killed it; 0: none.
        leftovers: other processes of its session still run.
        out_of_memory: used bytes and limit in bytes (0: none), if the OOM killer ended a process of
            the instance.
    """

    instance: Key
    code: int = 0
    signal: int = 0
    peak_memory: float = 0.0
    cpu_time: float = 0.0
    leftovers: bool = False
    out_of_memory: tuple[float, float] | None = None


class SessionEnded(NamedTuple):
    """The other processes of the session have ended, after the session leader."""

    instance: Key


class FencePassed(NamedTuple):
    """Too much time has passed since the last contact with the master."""

    instance: Key


class TimePassed(NamedTuple):
    """A deadline may have been reached."""


class Slept(NamedTuple):
    """This machine was suspended for some seconds, in which no process could run."""

    seconds: float


class ShutdownOrdered(NamedTuple):
    """A client or a signal ordered to stop all instances and the supervisor."""


class ClientLost(NamedTuple):
    """The connection to the client has ended; instances run on as long as their fences allow."""


Event = (
    StartOrdered
    | StopOrdered
    | FenceOrdered
    | ContactReported
    | RestartOrdered
    | AmendOrdered
    | FailOrdered
    | StatusStored
    | SlotFreed
    | Resumed
    | Spawned
    | SpawnFailed
    | Exited
    | SessionEnded
    | FencePassed
    | TimePassed
    | Slept
    | ShutdownOrdered
    | ClientLost
)
