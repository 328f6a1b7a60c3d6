"""Start of threads: a fault in a thread is always logged.

Python only prints the traceback of a thread that raises, and the part continues without it.
"""

# ruff: noqa: PLC0415, TID251 - a fault is rare, and memory is budgeted; the one place of threads

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Thread as Thread  # noqa: PLC0414 - exported for annotations
from typing import Final

from rosrm import clocks

#: Seconds before the first repetition, and the most between two; each pause doubles.
FIRST_PAUSE: Final = 1.0
LONGEST_PAUSE: Final = 60.0


def start(
    work: Callable[[], object], name: str, *, again: bool = False,
    failed: Callable[[BaseException], object] | None = None,
) -> Thread:  # fmt: skip
    """Start a thread that does not keep its process alive; log a fault.

    Args:
        work: called in the thread.
        name: of the thread.
        again: True: call `work` again after a fault; for a loop that serves until the end.
        failed: takes the fault, in the thread; for work that others wait for.

    Raises:
        RuntimeError: no further thread can be started: a limit of the user or of the group.
    """

    def run() -> None:
        pauses = Pauses()
        while True:
            try:
                work()
            except BaseException as fault:  # noqa: BLE001 - also the interrupt of a late call
                pause = pauses.after_fault() if again else 0.0
                log_fault(f"thread {name}", fault, pause)
                if failed is not None:
                    failed(fault)
                if again:
                    time.sleep(pause)
                    continue
            return

    thread = Thread(target=run, name=name, daemon=True)
    thread.start()
    return thread


class Pauses:
    """Pauses between the repetitions of work that fails."""

    def __init__(self) -> None:
        self._pause, self._begun = 0.0, clocks.awake_time()

    def after_fault(self) -> float:
        """Return the seconds until the repetition; they begin again after a long run."""
        now = clocks.awake_time()
        is_steady = now - self._begun > LONGEST_PAUSE + self._pause
        self._pause = FIRST_PAUSE if is_steady else min(2.0 * self._pause, LONGEST_PAUSE)
        self._pause, self._begun = max(self._pause, FIRST_PAUSE), now
        return self._pause


def log_fault(subject: str, fault: BaseException, pause: float = 0.0) -> None:
    """Log the fault of a thread or task, and the pause until it runs again; 0: it does not."""
    import logging

    from rosrm.errors import describe_fault, place_in_rosrm

    then = f"runs again in {pause:g} s" if pause else "has ended"
    place = place_in_rosrm(fault)
    log = logging.getLogger("rosrm.threads")
    log.error("%s: %s (%s); it %s", subject, describe_fault(fault), place, then)
