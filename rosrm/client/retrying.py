"""Retries of requests while the master does not answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar

from rosrm import clocks
from rosrm.errors import NoMaster, Refused

if TYPE_CHECKING:
    from rosrm.ros.master_connection import OnWait

T = TypeVar("T")

#: Takes a sentence about the progress of a call that lasts.
Notify = Callable[[str], None]

#: Seconds between two requests.
PERIOD: Final = 0.5
#: Seconds without an answer after which a message says so; a busy master may need one second.
_SILENCE: Final = 2.0
#: Seconds of further silence after which another message says so.
_STILL: Final = 30.0


def deadline_after(timeout: float | None) -> float:
    """Return the monotonic time at which a time-out (s) passes; never, for None."""
    return math.inf if timeout is None else clocks.boot_time() + timeout


def ask_until_answered(
    look: Callable[[OnWait], T], notify: Notify, deadline: float = math.inf
) -> T:
    """Return the master's answer, retrying until the deadline; notify if it is silent.

    Args:
        look: asks the master; raises `NoMaster` after some seconds without an answer. Its argument
            takes the seconds of a wait, repeatedly.
        notify: takes a message when the silence begins, one with the places to check, one every 30
            seconds of further silence, and one when the silence ends.
        deadline: monotonic seconds after which the silence is an error.

    Raises:
        NoMaster: the master was silent at the deadline.
        Refused: the master refuses what it is asked, or could not answer until the deadline.
    """
    failed, began = False, clocks.boot_time()
    asked = began
    said = -math.inf  # seconds of silence at the last message about it

    def on_wait(seconds: float) -> None:
        nonlocal said
        silence = asked - began + seconds
        is_due = silence >= _SILENCE and silence >= said + _STILL
        if is_due and clocks.boot_time() < deadline:
            said = silence
            notify(f"the master has not answered for {silence:.0f} s; still waiting")

    while True:
        asked = clocks.boot_time()
        on_wait(0.0)
        try:
            answer = look(on_wait)
        except (NoMaster, Refused) as error:
            is_final = isinstance(error, Refused) and not error.may_pass
            if is_final or clocks.boot_time() >= deadline:
                raise
            if not failed:
                failed, said = True, clocks.boot_time() - began
                notify(f"{error} Asking again until the master answers")
            time.sleep(PERIOD)
        else:
            if said > -math.inf:
                notify("the master answers again")
            return answer
