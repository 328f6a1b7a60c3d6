"""Where the supervisor keeps its files, below the state directory of its host.

One folder holds all of one host::

    supervisor.sock                the slave connects here
    supervisor.lock                held by the one live supervisor; holds its pid
    supervisor.log                 its own troubles
    instances.jsonl                the durable record
    heard                          when the master last heard this host
    logs/PROCESS.NUMBER.log        what an instance writes; .log.1 is older, and so on
    logs/PROCESS.NUMBER.log*.times when what was written (`log_index`)
    logs/PROCESS.NUMBER.*          further files of that instance (its parameters)
    work/                          working directory of the processes that name none

The logs lie in one folder, for a folder of its own made a short job half as expensive again.
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
_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-.")


def safe_name(process: str) -> str:
    """A process's name as the name of one file; different names stay different."""
    safe = "".join(
        c if c in _SAFE else "".join(f"%{b:02X}" for b in os.fsencode(c)) for c in process
    )
    return "%2E" + safe[1:] if safe.startswith(".") else safe


def log_folder(state: str) -> str:
    """Where the logs of all processes are."""
    return os.path.join(state, "logs")


def log_file(state: str, process: str, number: int) -> str:
    """The log of one instance."""
    return os.path.join(log_folder(state), f"{safe_name(process)}.{number}.log")


def log_number(name: str) -> tuple[str, int] | None:
    """The safe name and the number in the name of a log; None: it is no instance's current log."""
    found = _LOG_NAME.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def work_directory(state: str) -> str:
    """Where the processes run that name no working directory."""
    return os.path.join(state, "work")
