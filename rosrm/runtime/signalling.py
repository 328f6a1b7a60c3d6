"""Signals to other processes, which may have ended or may belong to another user.

Each function returns why the signal was refused; "": it was sent, or the process has ended. A pid
that is not known may read as 0 or -1, and the system would signal a whole group, or all processes.
"""

# ruff: noqa: TID251 - the one module that sends signals

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from rosrm.wording import reason_of


def send(pid: int, number: int) -> str:
    """Send a signal to a process."""
    return _sent(os.kill, pid, number) if pid > 0 else f"{pid} is no pid"


def send_to_group(leader: int, number: int) -> str:
    """Send a signal to a process group."""
    return _sent(os.killpg, leader, number) if leader > 0 else f"{leader} is no process group"


def send_by(pidfd: int, number: int) -> str:
    """Send a signal to the process of a descriptor, whose pid may be another process's by now."""
    return _sent(signal.pidfd_send_signal, pidfd, number)


def _sent(call: Callable[[int, int], None], target: int, number: int) -> str:
    try:
        call(target, number)
    except ProcessLookupError:
        return ""
    except OSError as error:  # a process of another user, or a filter of system calls
        return reason_of(error)
    return ""
