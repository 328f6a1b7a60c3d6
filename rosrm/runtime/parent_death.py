"""End of a process with its parent, also if the parent is killed."""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

from rosrm.runtime.signalling import send

#: Constant of linux/prctl.h.
_PR_SET_PDEATHSIG: Final = 1


def end_with_parent(parent: int) -> None:
    """Let the kernel send SIGTERM to this process when its parent ends; children are not included.

    Args:
        parent: pid of the parent. If it has ended already, this process gets SIGTERM now.

    Raises:
        OSError: the kernel refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:
        send(os.getpid(), signal.SIGTERM)
