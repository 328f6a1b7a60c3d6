"""Handlers of signals, except of those that the starter of this process ignores.

`nohup` ignores SIGHUP, and a shell without job control ignores SIGINT for a program with `&`. Such
a choice of the starter stays.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any] | int


def handle(numbers: Iterable[int], handler: Handler) -> dict[int, Any]:
    """Handle signals that the starter does not ignore; return their former handlers."""
    return {
        number: signal.signal(number, handler)
        for number in numbers
        if signal.getsignal(number) != signal.SIG_IGN
    }


@contextmanager
def handled(numbers: Iterable[int], handler: Handler) -> Iterator[None]:
    """Handle signals in this context, as `handle`."""
    former = handle(numbers, handler)
    try:
        yield
    finally:
        for number, before in former.items():
            signal.signal(number, before)
