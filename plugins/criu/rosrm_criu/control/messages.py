"""The two files of a control directory: `request`, for the node; `status`, its state.

    RUNNING -> LEAVING -> LEFT -> JOINING -> RUNNING
                  |                  |
                  +-> (refused)      +-> FAILED
                      RUNNING

Each is one JSON object of at most 64 KiB, and is replaced atomically. Standard library only.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Final, TypeVar

from rosrm.errors import PortableError
from rosrm.model.codec import from_plain, to_plain
from rosrm.wording import reason_of
from rosrm_criu.control.directory import opened

#: Environment variable that names the control directory of a process.
VARIABLE: Final = "ROSRM_PORTABLE"

#: Wakes a node that has a request. A real-time signal, because SIGUSR1 and SIGUSR2 belong to node
#: authors and their libraries (faulthandler, loggers). By default it ends a process, so it is sent
#: only to one that catches it. Debuggers and libraries prefer the first real-time signals.
SIGNAL: Final = int(signal.SIGRTMIN) + 5

FORMAT: Final = 1
_LARGEST: Final = 1 << 16
_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_PRESENT: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC


class Want(Enum):
    """The action that a request asks for."""

    LEAVE = "leave"
    JOIN = "join"


class State(Enum):
    """A node's relation to the ROS graph."""

    RUNNING = "running"
    LEAVING = "leaving"
    LEFT = "left"
    JOINING = "joining"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Request:
    """One request to a node.

    Attributes:
        id: identifies one departure: the same for leaving and rejoining, and never reused.
        want: the action.
    """

    id: str
    want: Want


@dataclass(frozen=True, slots=True)
class Status:
    """The state of a node, as the node reports it.

    Attributes:
        state: its relation to the ROS graph.
        request: id of the newest request that it has accepted; "": none yet.
        fault: why that request was refused, or why the node failed; "": neither.
        seconds: durations of the steps of the last departure: "leave"; "enter", until the node sees
            the other endpoints again; "join", until it has matched its peers. Besides these,
            "entries" is the number of attempts to enter the graph.
        missing: peers that it had before it left and did not match again in time.
    """

    state: State
    request: str = ""
    fault: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    missing: tuple[str, ...] = ()


_Content = TypeVar("_Content", Request, Status)
_FILES: Final[Mapping[type[Request | Status], str]] = {Request: "request", Status: "status"}


def write_message(directory: Path, content: Request | Status) -> None:
    """Replace a file atomically: a reader finds the old content or the new one; raise `OSError`."""
    name = _FILES[type(content)]
    beside = f".{name}.new"
    with opened(directory) as place:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(beside, dir_fd=place)  # a link left there must not be written through
        with os.fdopen(os.open(beside, _NEW, 0o666, dir_fd=place), "w", encoding="utf-8") as file:
            json.dump({"format": FORMAT, **to_plain(content)}, file)
        os.replace(beside, name, src_dir_fd=place, dst_dir_fd=place)


def read_message(directory: Path, kind: type[_Content]) -> _Content | None:
    """Return the request or the status of the node; None: there is none (yet).

    Raises:
        PortableError: the file cannot be read, or is not valid.
    """
    name = _FILES[kind]
    path = directory / name
    try:
        # The flags keep a FIFO from blocking, and the size limit keeps a large file out of memory.
        with opened(directory) as place:
            descriptor = os.open(name, _PRESENT, dir_fd=place)
        with os.fdopen(descriptor, "rb") as file:
            data = file.read(_LARGEST + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise PortableError(f"{path} cannot be read: {reason_of(error)}") from error
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise PortableError(f"{path} holds no JSON") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise PortableError(f"{path} is not of format {FORMAT}, which this rosrm speaks")
    known = {one.name: found[one.name] for one in fields(kind) if one.name in found}
    try:
        return from_plain(kind, known)
    except ValueError as error:
        raise PortableError(f"{path} is no {name}: {error}") from None


def remove_messages(directory: Path) -> None:
    """Remove both files; ignore errors."""
    for name in _FILES.values():
        with contextlib.suppress(OSError), opened(directory) as place:
            os.unlink(name, dir_fd=place)


def edition_of_request(directory: Path) -> tuple[int, ...]:
    """Return a value that differs for each written request; (): none. Opens no file."""
    try:
        found = os.lstat(directory / _FILES[Request])
    except OSError:
        return ()
    return (found.st_ino, found.st_mtime_ns, found.st_size)
