"""Errors of a journal, with cause and remedy in their messages."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from rosrm.errors import JournalBlocked, JournalError
from rosrm.runtime.disk_space import room_for

_OTHER_STATE = "give the master another `state:`"


def fault_of(path: Path, error: sqlite3.Error | OSError) -> JournalError:
    """Return the error for the user; a `JournalBlocked` if the failure may be temporary."""
    text = str(error)
    beginning = f"the journal {path} cannot be used ({text}); "
    cause = getattr(error, "strerror", None) or text

    def blocked(advice: str) -> JournalBlocked:
        return JournalBlocked(
            beginning + advice, f"the journal of the master cannot be used ({cause}); {advice}"
        )

    if os.path.isdir(path):  # noqa: PTH112 - unlike a Path it raises nothing
        return JournalError(f"{beginning}it is a directory: move it away, or {_OTHER_STATE}")
    if "full" in text or "No space" in text or "quota" in text:
        room = room_for(path)
        fault = blocked(f"the disk is full{room and f' ({room})'}: make room; {_NOTHING_LOST}")
        if room:
            fault.public = fault.public.replace(room, room.rpartition(" has ")[2])
        return fault
    if "I/O" in text:
        return blocked(
            f"writing to the disk fails: make room, check quotas and the disk itself; "
            f"{_NOTHING_LOST}"
        )
    if "unable to open" in text or "readonly" in text or isinstance(error, OSError):
        return blocked(
            f"check owner and permissions of the file, its folder and the files beside it (-wal, "
            f"-shm), or {_OTHER_STATE}"
        )
    if "locked" in text:
        return blocked(
            "another program has it open: does a second master use this state directory?"
        )
    return JournalError(beginning + DAMAGED)


def removed(path: Path) -> JournalBlocked:
    """Return the error for a file of the journal that was removed or replaced under the master."""
    text = "was removed or replaced while the master runs, so nothing new would be kept"
    return JournalBlocked(
        f"{path} {text}. Move it back if it was moved. Otherwise copy the deleted journal and its "
        f"-wal from /proc/{os.getpid()}/fd to {path.parent}, and restart the master. "
        f"A master with an empty journal stops the processes that it does not know",
        f"the journal of the master {text}. Its log says how to put the journal back",
    )


_NOTHING_LOST = "no acknowledged request is lost"


def unreadable(path: Path, fault: Exception) -> JournalError:
    """Return the error for an intact database with invalid content."""
    return JournalError(
        f"the journal {path} cannot be used ({type(fault).__name__}: {fault}); it was not written "
        f"by this rosrm: restore it from a backup, or move it away to start with an empty journal"
    )


#: Remedies for a damaged file.
DAMAGED = (
    "the file is damaged: restore it from a backup, or start the master once with `--recover`, "
    "which continues with its readable part and keeps the damaged file, or move it "
    "away to start with an empty journal. As long as no master runs, no process is stopped. Once "
    "one runs, it stops the processes that its journal lacks as their slaves register"
)


def other_version(path: Path, version: int, ours: int) -> JournalError:
    """Return the error for a journal of a later or earlier rosrm."""
    return JournalError(
        f"{path} was written by another version of rosrm (tables {version}, here {ours}); use that "
        f"version, or move the file away to start with an empty journal"
    )


def no_journal(path: Path) -> JournalError:
    """Return the error for a database that is no journal of rosrm."""
    return JournalError(
        f"the journal {path} cannot be used: it is a database of another program. Move it away, or "
        f"{_OTHER_STATE}"
    )
