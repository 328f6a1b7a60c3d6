"""Start of one process: a session leader with its output in a file, inheriting nothing else.

`os.posix_spawn` shares the parent's memory until the exec (vfork), so a spawn costs half a
millisecond. It cannot change the directory, so the supervisor (one thread) changes its own.
"""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Mapping
from typing import Final

#: Errors that may pass: the same spawn is tried again where the restart policy allows.
_TRANSIENT: Final = frozenset(
    {errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.ETXTBSY}
)
#: Python ignores some signals, so each is reset: a process starts with all at their default.
_EVERY_SIGNAL: Final = [
    number for number in signal.valid_signals() if number not in (signal.SIGKILL, signal.SIGSTOP)
]


class SpawnError(Exception):
    """The process cannot be started; the text says what was tried, where, and what is wrong.

    Only the first line is the reason: details such as a whole PATH go into further lines.

    Attributes:
        transient: the same spawn may succeed later.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient


class ScheduleRefused(SpawnError):
    """The process may not have the real-time scheduling."""


#: Real-time policy and parameters of a process.
Scheduler = tuple[int, os.sched_param]


def spawn(
    argv: tuple[str, ...], environment: Mapping[str, str], directory: str, null: int, log: int, *,
    group: int = -1, scheduler: Scheduler | None = None, nice: int = 0,
) -> int:  # fmt: skip
    """Start a process and return its pid. Raises SpawnError.

    Args:
        argv: command line; the first word is looked up in the PATH of `environment`.
        environment: the whole environment.
        null: descriptor that becomes its standard input.
        log: descriptor that becomes its standard output and error.
        group: descriptor of its control group of version 2; -1: that of this process.
        scheduler: None: that of this process.
        nice: niceness; 0: that of this process. Without the right to it, that of this process.
    """
    _enter(directory)
    path = find_executable(argv[0], environment)
    try:
        if group >= 0 or nice:  # `posix_spawn` can set neither
            from rosrm.supervisor.spawn_into import spawn_into  # noqa: PLC0415 - loads 400 KiB

            program = (path, argv, environment)
            return spawn_into(group, program, null=null, log=log, scheduler=scheduler, nice=nice)
        return os.posix_spawn(
            path,
            argv,
            environment,
            file_actions=[
                (os.POSIX_SPAWN_DUP2, null, 0),
                (os.POSIX_SPAWN_DUP2, log, 1),
                (os.POSIX_SPAWN_DUP2, log, 2),
            ],
            setsid=True,
            setsigmask=(),
            setsigdef=_EVERY_SIGNAL,
            **({} if scheduler is None else {"scheduler": scheduler}),  # type: ignore[arg-type]
        )
    except OSError as error:
        if scheduler is not None and error.errno == errno.EPERM:
            raise ScheduleRefused(f"{path} may not have real-time scheduling here") from None
        transient = error.errno in _TRANSIENT
        raise SpawnError(_why(path, directory, error), transient=transient) from None
    except ValueError as error:  # a NUL byte in an argument, a "=" in a variable's name
        raise SpawnError(f"{argv[0]!r} cannot be started: {error}") from None
    finally:
        os.chdir("/")  # otherwise the supervisor would keep a user's mount busy


def _enter(directory: str) -> None:
    try:
        os.chdir(directory)
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        reason = getattr(error, "strerror", None) or error
        message = f"the working directory {directory!r} cannot be entered: {reason}"
        raise SpawnError(message) from None


#: Cache of program paths, with the times at which they expire, because a search makes a system call
#: for each directory of the PATH, and jobs often run the same program.
_found: Final[dict[tuple[str, str], tuple[str, float]]] = {}
#: Seconds for which a path is cached; most cached paths.
_KEPT_FOR: Final = 1.0
_MOST_KEPT: Final = 100


def find_executable(word: str, environment: Mapping[str, str]) -> str:
    """Return the path of the program that a command's first word names. Raises SpawnError."""
    if "/" in word:
        return word
    search = environment.get("PATH", os.defpath)
    path, until = _found.get((word, search), ("", 0.0))
    now = time.monotonic()
    if now < until and os.access(path, os.X_OK):
        return path
    path = _search(word, search)
    if os.path.isabs(path):  # a relative path depends on the working directory
        if len(_found) >= _MOST_KEPT:
            _found.clear()
        _found[word, search] = path, now + _KEPT_FOR
    return path


def _search(word: str, search: str) -> str:
    reason = f"program {word!r} is not on the PATH"
    for directory in search.split(os.pathsep):
        path = os.path.join(directory or ".", word)
        if os.path.isfile(path):
            if os.access(path, os.X_OK):
                return path
            reason = f"program {word!r} on the PATH, {path}, is not executable"
    raise SpawnError(f"{reason}\nthe PATH is {search}")


def _why(path: str, directory: str, error: OSError) -> str:
    path = os.path.join(directory, path)
    if error.errno == errno.ENOENT and os.path.exists(path):
        return f"{path} cannot be started: the interpreter in its first line does not exist"
    if error.errno == errno.ENOENT:
        return f"no executable {path!r} exists"
    if error.errno == errno.EACCES:
        return f"{path} cannot be started: it is not executable, or may not be reached"
    if error.errno == errno.ENOEXEC:
        return f"{path} cannot be started: it is neither a program nor a script with #!"
    return f"{path} cannot be started: {error.strerror}"
