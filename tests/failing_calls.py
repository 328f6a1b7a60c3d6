"""Harness for code that must survive the failure of any one of its system calls.

A profile function raises the error in place of the call. Every later call succeeds.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: Built-in functions and methods that may lack memory, a descriptor, room on a disk or a process.
#: A close, a signal and a wait for a child need nothing, and are not among them.
CALLS = frozenset(
    ["dup", "dup2", "epoll", "flock", "fork", "fork_exec", "fstat", "fsync", "ftruncate", "listdir",
     "lstat", "mkdir", "open", "pidfd_open", "pipe2", "pwrite", "read", "readlink", "register",
     "rename", "replace", "rmdir", "scandir", "stat", "statvfs", "symlink", "unlink", "write"]
)  # fmt: skip


class Count:
    """Counted calls.

    Attributes:
        left: calls until the one that fails.
        failed: name and caller of the call that failed; "": none yet.
    """

    def __init__(self, left: int) -> None:
        self.left = left
        self.failed = ""


@contextmanager
def nth_call_fails(
    n: int, number: int = errno.ENOMEM, also: Iterable[Callable[..., Any]] = ()
) -> Iterator[Count]:
    """Let the nth call of this thread in this context fail, counted from 0.

    Args:
        n: number of calls that succeed before.
        number: errno of the error.
        also: functions in Python that count as calls, such as those that call C by ctypes.
    """
    count, me, others = Count(n), os.getpid(), {call.__code__ for call in also}

    def look(frame: FrameType, event: str, called: Any) -> None:
        if event == "c_call" and called.__name__ in CALLS:
            name, caller = called.__name__, frame
        elif event == "call" and frame.f_code in others:
            name, caller = frame.f_code.co_name, frame.f_back or frame
        else:
            return
        # A child that was forked here has its own failures.
        if isinstance(getattr(called, "__self__", None), _NO_FILES) or os.getpid() != me:
            return
        count.left -= 1
        if count.left == -1:
            where = f"{caller.f_code.co_filename.rpartition('rosrm/')[2]}:{caller.f_lineno}"
            count.failed = f"{name} in {where}"
            raise OSError(number, os.strerror(number))

    sys.setprofile(look)
    try:
        yield count
    finally:
        sys.setprofile(None)


#: Types with methods that have names of `CALLS` and call no system call.
_NO_FILES = (str, bytes, list, dict, type)


@contextmanager
def uncounted() -> Iterator[None]:
    """Exempt the calls in this context, which are those of the test, from counting and failures."""
    former = sys.getprofile()
    sys.setprofile(None)
    try:
        yield
    finally:
        sys.setprofile(former)
