"""The journal contract, for every journal implementation."""

from rosrm.journal.sqlite import SqliteJournal
from rosrm.testing import JournalContract, MemoryJournal


class TestSqlite(JournalContract):
    def open(self, directory):
        return SqliteJournal(directory / "journal.sqlite")


class TestMemory(JournalContract):
    durable = False

    def open(self, directory):
        return MemoryJournal()
