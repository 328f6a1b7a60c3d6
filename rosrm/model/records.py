"""Values in the journal, and the protocol of a journal: event record and intents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from rosrm.model.event_kinds import EventKind
from rosrm.model.values import EMPTY


@dataclass(frozen=True, slots=True)
class Record:
    """One line of the event record.

    Attributes:
        process: name of the process; "" for none.
        host: name of the host; "" for none.
        message: one sentence for logs and listings; details in further lines, which only the owner
            of the process and operators may read.
        facts: details by name, valid JSON.
    """

    kind: EventKind
    process: str = ""
    host: str = ""
    message: str = ""
    facts: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """A record in the journal.

    Attributes:
        sequence: 1, 2, 3, ... without a gap.
        wall_time: unix time by the master's clock, seconds.
        elapsed: seconds since this master's start, by its monotonic clock.
    """

    sequence: int
    wall_time: float
    elapsed: float
    record: Record


@dataclass(frozen=True, slots=True)
class Intent:
    """A durable value of the desired state; the newest value of a key replaces older ones.

    Attributes:
        table: "process", "migration", "host", "learned", "cluster" or "removed".
        key: key within the table.
        value: valid JSON; None: remove the key.
    """

    table: str
    key: str
    value: Mapping[str, Any] | None


@runtime_checkable
class Journal(Protocol):
    """Stores intents and the event record; they survive a SIGKILL once `write` has returned."""

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], now: float
    ) -> Sequence[StoredRecord]:
        """Append records and replace intents in one atomic group; raises `JournalError`."""

    def intents(self, table: str) -> Mapping[str, Mapping[str, Any]]:
        """Return all intents of a table by key."""

    def records(
        self, *, after: int = 0, process: str = "", host: str = "", newest: int = 1000
    ) -> Sequence[StoredRecord]:
        """Return the newest matching records after a sequence, oldest first.

        The records of a host include migrations from it, whose facts have the host as `from`.
        """

    def close(self) -> None:
        """Flush and close the files."""
