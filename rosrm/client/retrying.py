"""Retries of requests while the master does not answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final, TypeVar

from rosrm.errors import NoMaster

T = TypeVar("T")

#: Takes a sentence about the progress of a call that lasts.
Notify = Callable[[str], None]

#: Seconds between two requests.
PERIOD: Final = 0.5


def deadline_after(timeout: float | None) -> float:
    """Return the monotonic time at which a time-out (s) passes; never, for None."""
    return math.inf if timeout is None else time.monotonic() + timeout


def ask_until_answered(look: Callable[[], T], notify: Notify, deadline: float = math.inf) -> T:
    """Return the master's answer, retrying until the deadline; notify once if it is silent.

    Args:
        look: asks the master; raises `NoMaster` after some seconds without an answer.
        notify: takes a message when the silence begins, and one when it ends.
        deadline: monotonic seconds after which the silence is an error.

    Raises:
        NoMaster: the master was silent at the deadline.
    """
    silent = False
    while True:
        try:
            answer = look()
        except NoMaster as error:
            if time.monotonic() >= deadline:
                raise
            if not silent:
                notify(f"{error} Asking again until the master answers")
            silent = True
            time.sleep(PERIOD)
        else:
            if silent:
                notify("the master answers again")
            return answer
