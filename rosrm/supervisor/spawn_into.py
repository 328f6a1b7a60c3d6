"""Fork into a control group of version 2 (clone3 with CLONE_INTO_CGROUP).

Python cannot do that, so this module calls the kernel. Where the kernel or a filter of system calls
refuses clone3, the child enters the group itself, which takes some 10 ms from Linux 6.0 on.

The parent may have further threads (`file_thread`). So the child makes new locks of the
interpreter, as after `os.fork`. The locks of malloc are free in the child: each thread has an arena
of its own, and uses that of the loop only with the interpreter's lock, which the loop has here.
"""

from __future__ import annotations

import ctypes
import errno
import os
import signal
from typing import Final

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
_before, _in_child, _in_parent = (
    ctypes.pythonapi.PyOS_BeforeFork, ctypes.pythonapi.PyOS_AfterFork_Child,
    ctypes.pythonapi.PyOS_AfterFork_Parent,
)  # fmt: skip
for _call in (_before, _in_child, _in_parent):
    _call.restype = None


def fork_into(group: int) -> int | None:
    """Fork a child in a group; return its pid, 0 in the child; None: clone3 is refused.

    Args:
        group: descriptor of the group's directory.

    Raises:
        OSError: the group is gone.
    """
    wanted = _CloneArguments(
        flags=_CLONE_INTO_CGROUP, exit_signal=signal.SIGCHLD.value, cgroup=group
    )
    where, size = ctypes.byref(wanted), ctypes.sizeof(wanted)
    _before()
    pid = _libc.syscall(_CLONE3, where, size)
    (_in_parent if pid else _in_child)()
    if pid >= 0:
        return int(pid)
    number = ctypes.get_errno()
    if number in _REFUSED:
        return None
    raise OSError(number, os.strerror(number))
