"""Deferral of signal handlers that raise while rclpy runs.

rclpy calls Python from C++, for example to convert a message. A KeyboardInterrupt there becomes
another error, which a callback's guard drops with the message, so Ctrl-C would have no effect.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Final

#: Signals whose handlers end programs, mostly by an exception.
_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Return a context in which signals that end a program wait for its end.

    Then the program's own handler is called once for each of them. Signals with the handler of the
    system are not deferred, and nothing is in other threads, where Python runs no handler.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: dict[int, FrameType | None] = {}
    handlers = {int(one): handler for one in _ENDING if callable(handler := signal.getsignal(one))}
    for number in handlers:
        signal.signal(number, arrived.__setitem__)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        with ExitStack() as calls:  # each handler is called, also if another one raises
            for arrival, frame in reversed(arrived.items()):
                calls.callback(handlers[arrival], arrival, frame)
