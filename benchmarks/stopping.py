"""Begin and end of a benchmark: its keys, and the signals and errors that end it."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from types import FrameType

from benchmarks.machine import say
from rosrm.errors import RosrmError


class Stopped(BaseException):
    """A signal came; not an `Exception`, so that no handler on the way catches it.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def raise_signals() -> None:
    """Make SIGINT, SIGTERM and SIGHUP raise `Stopped`; only the first one does."""
    main_process = os.getpid()

    def stop(number: int, _: FrameType | None) -> None:
        if os.getpid() != main_process:  # pyroute2 forks, and ends its children by SIGTERM
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(one, signal.SIG_IGN)  # a second signal does not interrupt the clean-up
        raise Stopped(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)


@contextlib.contextmanager
def own_keys() -> Iterator[None]:
    """Make all parts use keys in a temporary directory, and not those of the user."""
    users = {name: os.environ.pop(name, None) for name in ("ROSRM_KEY", "ROSRM_KEYS")}
    with tempfile.TemporaryDirectory(prefix="rosrm-keys-") as directory:
        os.environ["ROSRM_KEYS"] = directory
        try:
            yield
        finally:
            del os.environ["ROSRM_KEYS"]
            os.environ.update({name: path for name, path in users.items() if path is not None})


def run(name: str, main: Callable[[], int | None]) -> int:
    """Run a benchmark with keys of its own; return its exit status.

    The status is 2 where something is missing or failed, 128 + signal number after a signal.
    """
    raise_signals()
    try:
        with own_keys():
            return main() or 0
    except Stopped as stopped:
        say(f"benchmarks.{name}: stopped by {stopped}")
        return 128 + stopped.number
    except (RosrmError, OSError) as error:
        say(f"benchmarks.{name}: {error}")
        return 2
