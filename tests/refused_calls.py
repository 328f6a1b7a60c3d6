"""A filter of system calls (seccomp) for the programs that a test starts."""

from __future__ import annotations

import ctypes
import errno
import struct
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

#: Numbers that are the same on all architectures with 64 bits.
CLONE3, PIDFD_OPEN, CLOSE_RANGE, PIDFD_SEND_SIGNAL = 435, 434, 436, 424
_SET_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000


class _Program(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]


def without_calls(call: Callable[[], T], *numbers: int, error: int = errno.EPERM) -> T:
    """Return the result of a call whose programs may not use some system calls.

    The call runs in a thread of its own, because a filter stays: it is that of the thread, and of
    the programs that the thread starts.
    """
    results: list[T] = []
    faults: list[BaseException] = []

    def work() -> None:
        try:
            _refuse(numbers, error)
            results.append(call())
        except BaseException as fault:  # noqa: BLE001 - raised again below
            faults.append(fault)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    for fault in faults:
        raise fault
    return results[0]


def _refuse(numbers: tuple[int, ...], error: int) -> None:
    steps = [(_LOAD, 0, 0, 0)]
    for number in numbers:
        steps += [(_JUMP_IF_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ERRNO | error)]
    steps.append((_RETURN, 0, 0, _ALLOW))
    code = b"".join(struct.pack("HBBI", *step) for step in steps)
    program = _Program(len(steps), code)
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(_SET_NO_NEW_PRIVILEGES, 1, 0, 0, 0) == 0
    assert libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(program), 0, 0) == 0
