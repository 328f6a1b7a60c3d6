"""Commands of the slave's core to its runtime, in the imperative."""

from __future__ import annotations

from dataclasses import dataclass

from rosrm.core.slave.watches import Memo
from rosrm.model.values import Assignment, InstanceId, InstanceStatus, RestartPolicy


@dataclass(frozen=True, slots=True)
class Launch:
    """Have the supervisor start instances."""

    assignments: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class Stop:
    """Have the supervisor stop an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Fence:
    """Have the supervisor end an instance at once."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Renew:
    """Send the supervisor the time of the last contact, and the time at which this slave runs.

    Attributes:
        at: newest time at which the master received a message of this host.
        alive: time at which this slave runs.

    Both by the monotonic clock.
    """

    at: float
    alive: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Have the supervisor restart an instance."""

    instance: InstanceId


@dataclass(frozen=True, slots=True)
class Fail:
    """Have the supervisor end a run as failed, and apply its restart policy.

    Attributes:
        pid: of the run.
        kill: SIGKILL at once, because the process is stopped by a signal.
    """

    instance: InstanceId
    pid: int
    reason: str
    kill: bool


@dataclass(frozen=True, slots=True)
class Amend:
    """Have the supervisor keep another restart policy; `RestartPolicyRecorded` follows."""

    instance: InstanceId
    restart: RestartPolicy


@dataclass(frozen=True, slots=True)
class Settle:
    """Answer the order to set this restart policy; `refusal`: why that failed; "": it is set."""

    instance: InstanceId
    restart: RestartPolicy
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Remember:
    """Have the supervisor keep these facts for a later run of this slave."""

    instance: InstanceId
    memo: Memo


@dataclass(frozen=True, slots=True)
class Forget:
    """Let the supervisor forget ended instances."""

    instances: tuple[InstanceId, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """Report statuses to the master; `complete`: these are all."""

    statuses: tuple[InstanceStatus, ...]
    complete: bool = False


Command = (
    Launch | Stop | Fence | Renew | Restart | Fail | Amend | Settle | Remember | Forget | Report
)
