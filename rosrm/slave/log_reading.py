"""Parts of a process's log, for `rosrm logs`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from rosrm.core.model import InstanceId
from rosrm.errors import Refused
from rosrm.ros.slave_endpoint import LogSlice
from rosrm.supervisor.client import log_path, newest_log

#: Most bytes in one answer.
_MOST: Final = 1 << 20
#: Of an instance that is being started: its file is opened with it.
NOTHING_YET: Final = LogSlice(b"", 0, 0, False)


def read_log(
    state_directory: Path, instance: InstanceId, offset: int, max_bytes: int, *, ended: bool
) -> LogSlice:
    """Read a part of the current log file of an instance.

    Args:
        state_directory: of the supervisor.
        offset: bytes from the start; negative: from the end.
        max_bytes: 0: as many as one answer holds.
        ended: the instance has ended.

    Raises:
        Refused: there is no log of it.
    """
    path = log_path(state_directory, instance)
    try:
        with path.open("rb") as log:
            status = os.fstat(log.fileno())
            size = status.st_size
            start = max(0, size + offset) if offset < 0 else offset
            if start > size:
                start = 0  # it was cut, and no part of it was kept
            log.seek(start)
            content = log.read(min(max_bytes or _MOST, _MOST))
    except FileNotFoundError:
        raise Refused(f"there is no log of {instance} here (any more): {path}", "unknown") from None
    at_end = start + len(content) >= size
    return LogSlice(content, start + len(content), _generation(path), ended and at_end)


def _generation(path: Path) -> int:
    """Changes with each rotation: the file before this one is then another."""
    try:
        return path.with_name(path.name + ".1").stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def newest_instance(state_directory: Path, process: str) -> InstanceId:
    """The newest instance of a process that has a log here.

    Raises:
        Refused: none has.
    """
    newest = newest_log(state_directory, process)
    if newest is None:
        raise Refused(f"this host has no log of {process}", "unknown")
    return newest
