"""Paths of the supervisor's files below the state directory of its host.

One folder holds all files of one host::

    supervisor.sock                the slave connects here
    supervisor.lock                held by the one live supervisor; holds its pid
    supervisor.log                 the supervisor's own problems
    instances.jsonl                the durable record
    heard                          time of the last contact with the master
    logs/PROCESS.NUMBER.log        output of an instance; .log.1 is older, and so on
    logs/PROCESS.NUMBER.log*.times time index of that output (`log_index`)
    logs/PROCESS.NUMBER.*          further files of that instance (its parameters, its key)
    work/                          default working directory of processes

All logs lie in one folder, because a folder per instance made a short job half as expensive again.
"""

from __future__ import annotations

import os
import re

SOCKET = "supervisor.sock"
LOCK = "supervisor.lock"
OWN_LOG = "supervisor.log"
RECORD = "instances.jsonl"
HEARD = "heard"

_LOG_NAME = re.compile(r"(.+)\.([0-9]+)\.log")
_ANY_LOG_FILE = re.compile(
    r"(.+)\.([0-9]+)\.(?:log(?:\.([0-9]+))?(?:\.[a-z.]+)?|parameters\.yaml|key)"
)
_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-.")


def safe_name(process: str) -> str:
    """Return the name of a process as a file name; different names stay different."""
    safe = process if _SAFE.issuperset(process) else "".join(map(_safe_letter, process))
    return "%2E" + safe[1:] if safe.startswith(".") else safe


def _safe_letter(letter: str) -> str:
    return letter if letter in _SAFE else "".join(f"%{b:02X}" for b in os.fsencode(letter))


def log_folder(state: str) -> str:
    """Return the folder of the logs of all processes."""
    return os.path.join(state, "logs")


def log_file(state: str, process: str, number: int) -> str:
    """Return the path of the current log of an instance."""
    return os.path.join(log_folder(state), f"{safe_name(process)}.{number}.log")


def log_number(name: str) -> tuple[str, int] | None:
    """Return the safe name and number in a log's file name; None: no instance's current log."""
    found = _LOG_NAME.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def instance_of(name: str) -> tuple[str, int] | None:
    """Return the safe name and number of the instance that a file in the log folder belongs to."""
    found = _ANY_LOG_FILE.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def age_of(name: str) -> int:
    """Return the number of rotations since a log, or its index, was current; 0: it is current."""
    found = _ANY_LOG_FILE.fullmatch(name)
    return int(found[3]) if found and found[3] else 0


def work_directory(state: str) -> str:
    """Return the working directory of processes that name none."""
    return os.path.join(state, "work")
