"""End of a command whose reader has gone, as in `rosrm events -f | head -1`.

The command would notice it only when it prints the next line, which may never come.
"""

from __future__ import annotations

import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Final

from rosrm import threads

#: Seconds to the next attempt to end.
_AGAIN: Final = 0.5


@contextmanager
def needed() -> Iterator[None]:
    """Exit with 1, as after a broken pipe, as soon as the reader of standard output has gone."""
    try:
        descriptor = sys.stdout.fileno()
    except OSError:  # a caller in Python may have replaced the standard output
        yield
        return
    before = signal.signal(signal.SIGPIPE, _end)
    threads.start(partial(_watch, descriptor), "reader")
    try:
        yield
    finally:
        signal.signal(signal.SIGPIPE, before)


def _watch(descriptor: int) -> None:
    poll = select.poll()
    poll.register(descriptor, 0)  # errors and hang-ups are always reported
    poll.poll()
    while True:  # an exception in a callback of a library may be ignored
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGPIPE)
        time.sleep(_AGAIN)


def _end(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(1)
