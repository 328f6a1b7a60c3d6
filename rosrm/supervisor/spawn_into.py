"""Start of a process in a control group of version 2 (clone3 with CLONE_INTO_CGROUP), or niced.

Neither Python nor `posix_spawn` of older C libraries can do that, so this module calls the kernel.
The child shares no memory with the supervisor, unlike one of `posix_spawn`, and executes this
module until its exec. Where the kernel or a filter of system calls refuses clone3, the child enters
the group itself, which takes some 10 ms from Linux 6.0 on.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
from collections.abc import Mapping, Sequence
from typing import Final, NoReturn

_CLONE3: Final = 435  # on all architectures
_CLONE_INTO_CGROUP: Final = 0x200000000
_REFUSED: Final = (errno.ENOSYS, errno.EPERM, errno.EINVAL, errno.E2BIG, errno.EOPNOTSUPP)
#: Fields of `struct clone_args`.
_FIELDS: Final = (
    "flags", "pidfd", "child_tid", "parent_tid", "exit_signal", "stack", "stack_size", "tls",
    "set_tid", "set_tid_size", "cgroup",
)  # fmt: skip


class _CloneArguments(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint64) for name in _FIELDS]


# PyDLL keeps the lock of the interpreter during the call, so the child owns it.
_libc = ctypes.PyDLL(None, use_errno=True)
_libc.syscall.restype = ctypes.c_long


def spawn_into(
    group: int, program: tuple[str, Sequence[str], Mapping[str, str]], *, null: int, log: int,
    scheduler: tuple[int, os.sched_param] | None, nice: int = 0,
) -> int:  # fmt: skip
    """Start a session leader in a group, and return its pid.

    Args:
        group: descriptor of the group's directory; -1: the group of this process.
        program: its path, arguments and environment.
        null, log, scheduler, nice: as in `spawn.spawn`.

    Raises:
        OSError: the group is gone, the scheduling is not permitted (EPERM), or the program cannot
            be executed.
        ValueError: an argument or a variable cannot be passed to a program.
    """
    encoded = _encoded(*program)  # before the fork
    report, told = os.pipe2(os.O_CLOEXEC)
    try:
        pid, inside = _fork(group)
    except OSError:
        os.close(report)
        os.close(told)
        raise
    if pid == 0:
        try:
            if not inside:
                os.write(os.open("cgroup.procs", os.O_WRONLY, dir_fd=group), b"0")
            if nice:
                with contextlib.suppress(OSError):  # the caller compares the result
                    os.setpriority(os.PRIO_PROCESS, 0, nice)
            _become(encoded, null, log, scheduler)
        except OSError as error:
            os.write(told, str(error.errno).encode())
        finally:
            os._exit(127)
    os.close(told)
    try:
        failure = os.read(report, 16)  # the exec closes the other end
    finally:
        os.close(report)
    if failure:
        os.waitpid(pid, 0)
        raise OSError(int(failure), os.strerror(int(failure)))
    return pid


_Program = tuple[str, list[bytes], Mapping[bytes, bytes]]


def _encoded(path: str, argv: Sequence[str], environment: Mapping[str, str]) -> _Program:
    arguments = [os.fsencode(word) for word in argv]
    variables = {os.fsencode(name): os.fsencode(value) for name, value in environment.items()}
    if any(b"\0" in word for word in (*arguments, *variables, *variables.values())):
        raise ValueError("embedded null byte")
    if any(b"=" in name or not name for name in variables):
        raise ValueError("illegal environment variable name")
    return path, arguments, variables


def _fork(group: int) -> tuple[int, bool]:
    """Return the pid, 0 in the child, and True if the child is in the group already."""
    if group < 0:
        return os.fork(), True
    wanted = _CloneArguments(
        flags=_CLONE_INTO_CGROUP, exit_signal=signal.SIGCHLD.value, cgroup=group
    )
    pid = _libc.syscall(_CLONE3, ctypes.byref(wanted), ctypes.sizeof(wanted))
    if pid >= 0:
        return pid, True
    number = ctypes.get_errno()
    if number not in _REFUSED:
        raise OSError(number, os.strerror(number))
    return os.fork(), False


def _become(
    program: _Program, null: int, log: int, scheduler: tuple[int, os.sched_param] | None
) -> NoReturn:
    """Turn the child into the program. Raises OSError."""
    if scheduler is not None:
        os.sched_setscheduler(0, *scheduler)
    os.setsid()
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    for descriptor, its in ((null, 0), (log, 1), (log, 2)):
        os.dup2(descriptor, its)
    os.execve(*program)  # noqa: S606 - no shell is wanted
