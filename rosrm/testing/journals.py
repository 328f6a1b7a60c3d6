"""In-memory journal, and the contract of journals with the master."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar
from unittest import SkipTest

from rosrm import clocks
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Journal, Record, StoredRecord


@dataclass
class MemoryJournal:
    """In-memory implementation of `rosrm.model.records.Journal`.

    Attributes:
        stored: every record, oldest first.
        tables: intents by table and key.
        closed: `close` was called.
    """

    stored: list[StoredRecord] = field(default_factory=list)
    tables: dict[str, dict[str, Mapping[str, Any]]] = field(default_factory=dict)
    closed: bool = False

    def write(
        self, records: Sequence[Record], intents: Sequence[Intent], now: float
    ) -> Sequence[StoredRecord]:
        """Append records and replace intents."""
        first = len(self.stored) + 1
        wall = clocks.wall_time()
        stored = [StoredRecord(first + at, wall, now, record) for at, record in enumerate(records)]
        self.stored += stored
        for intent in intents:
            table = self.tables.setdefault(intent.table, {})
            if intent.value is None:
                table.pop(intent.key, None)
            else:
                table[intent.key] = json.loads(json.dumps(dict(intent.value)))
        return stored

    def intents(self, table: str) -> Mapping[str, Mapping[str, Any]]:
        """Return all intents of a table by key."""
        return dict(self.tables.get(table, {}))

    def records(
        self, *, after: int = 0, process: str = "", host: str = "", newest: int = 1000
    ) -> Sequence[StoredRecord]:
        """Return the newest matching records after a sequence, oldest first."""
        matching = [
            stored
            for stored in self.stored
            if stored.sequence > after
            and process in ("", stored.record.process)
            and host in ("", stored.record.host, stored.record.facts.get("from"))
        ]
        return matching[max(0, len(matching) - newest) :]

    def close(self) -> None:
        """Set `closed`."""
        self.closed = True


class JournalContract:
    """Contract of a journal with the master. Override `open`.

    Attributes:
        durable: True if a reopened journal has the written records and intents.
    """

    durable: ClassVar[bool] = True

    def open(self, directory: Path) -> Journal:
        """Return the journal in a directory, created if it does not exist."""
        raise NotImplementedError

    def test_numbers_records_without_a_gap(self, tmp_path: Path) -> None:
        """The journal numbers records 1, 2, 3, ... over all groups, and keeps their time stamps."""
        journal = self.open(tmp_path)
        assert isinstance(journal, Journal)
        first = journal.write(
            [Record(EventKind.SUBMITTED, "p"), Record(EventKind.ASSIGNED, "p", "h")], [], 0.5
        )
        second = journal.write([Record(EventKind.FAILED, "p", "h", facts={"code": 3})], [], 1.5)
        assert [stored.sequence for stored in [*first, *second]] == [1, 2, 3]
        assert [stored.elapsed for stored in journal.records()] == [0.5, 0.5, 1.5]
        assert list(journal.records()) == [*first, *second]
        journal.close()

    def test_selects_records(self, tmp_path: Path) -> None:
        """The journal selects records by process, by host and after a sequence.

        The records of a host include migrations from it. Of too many records the newest count.
        """
        journal = self.open(tmp_path)
        moved = Record(EventKind.MIGRATED, facts={"from": "source", "to": "i"})
        journal.write(
            [
                Record(EventKind.ASSIGNED, "p", "h"),
                Record(EventKind.READY, "q", "h"),
                Record(EventKind.FAILED, "p", "i"),
                moved,
            ],
            [],
            0,
        )
        kinds = {
            "assigned ready failed migrated": journal.records(),
            "assigned failed": journal.records(process="p"),
            "assigned ready": journal.records(host="h"),
            "migrated": journal.records(host="source"),
            "failed": journal.records(process="p", after=1),
            "failed migrated": journal.records(newest=2),
            "": journal.records(process="unknown"),
        }
        for expected, found in kinds.items():
            assert " ".join(stored.record.kind for stored in found) == expected
        journal.close()

    def test_newest_intent_counts(self, tmp_path: Path) -> None:
        """A later intent replaces an earlier one, also within a group; None removes the key."""
        journal = self.open(tmp_path)
        journal.write([], [Intent("process", "p", {"n": 1}), Intent("process", "q", {"n": 1})], 0)
        journal.write([], [Intent("process", "p", {"n": 2}), Intent("process", "p", {"n": 3})], 0)
        journal.write([], [Intent("process", "q", None), Intent("process", "gone", None)], 0)
        assert journal.intents("process") == {"p": {"n": 3}}
        assert journal.intents("migration") == {}
        journal.close()

    def test_survives_being_closed(self, tmp_path: Path) -> None:
        """A reopened journal has its records and intents, and continues the sequence."""
        if not self.durable:
            raise SkipTest("this journal is not durable")
        journal = self.open(tmp_path)
        journal.write([Record(EventKind.SUBMITTED)], [Intent("host", "h", {"cordoned": True})], 0)
        journal.close()
        again = self.open(tmp_path)
        assert again.intents("host") == {"h": {"cordoned": True}}
        assert [stored.sequence for stored in again.write([Record(EventKind.QUEUED)], [], 0)] == [2]
        assert [stored.record.kind for stored in again.records()] == [
            EventKind.SUBMITTED, EventKind.QUEUED,
        ]  # fmt: skip
        again.close()
