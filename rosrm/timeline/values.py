"""Values of a timeline. All times are seconds since its first event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

#: State of a process at the end of the timeline.
Outcome = Literal["finished", "failed", "cancelled", "running", "waiting"]


#: What a host is while it is gone.
GONE: Final = ("lost", "left", "detached")


@dataclass(frozen=True, slots=True)
class Placement:
    """Time of a process on one host.

    Attributes:
        number: of the instance; 0: not known.
        ended_by: kind of the event that ended it; "": it had not ended at the end of the timeline.
    """

    process: str
    host: str
    begin: float
    end: float
    number: int = 0
    ended_by: str = ""


@dataclass(frozen=True, slots=True)
class Move:
    """A process that changed its host, or a migration that failed.

    A migration within a host, e.g. to the instance of a new version, counts as a replacement.

    Attributes:
        time: of its end.
        how: strategy of the migration; "restart": the process was started again elsewhere.
        seconds: duration of the migration; None: no migration.
        done: False: the process stayed.
    """

    time: float
    process: str
    source: str
    destination: str
    how: str
    cause: str
    seconds: float | None = None
    done: bool = True

    @property
    def within(self) -> bool:
        """Return True if both instances were on the same host."""
        return self.source == self.destination


@dataclass(frozen=True, slots=True)
class Wait:
    """Time of a process in the queue or set aside.

    Attributes:
        reason: the newest known reason; "": it did not have to wait for a host.
        over: False: it still waited at the end of the timeline.
    """

    process: str
    begin: float
    end: float
    reason: str = ""
    over: bool = True

    @property
    def seconds(self) -> float:
        """Return its duration."""
        return self.end - self.begin


@dataclass(frozen=True, slots=True)
class Start:
    """A start of a process on a host, from its assignment until it was running or ready."""

    process: str
    host: str
    time: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Failure:
    """An instance that ended with a failure.

    Attributes:
        restarts: the process was started again.
        lines: last lines of its log; empty: not known.
    """

    time: float
    process: str
    host: str
    number: int
    message: str
    restarts: bool
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HostSpan:
    """Time in which a host was gone, or over its limit of a resource.

    Attributes:
        what: "lost", "left", "detached", or the resource.
    """

    host: str
    what: str
    begin: float
    end: float

    @property
    def is_gone(self) -> bool:
        """Return True if the host was gone, and not over a limit."""
        return self.what in GONE

    @property
    def phrase(self) -> str:
        """Return "HOST is lost", or "HOST is over its limit of RESOURCE"."""
        predicate = self.what if self.is_gone else f"over its limit of {self.what}"
        return f"{self.host} is {predicate}"
