"""Terminal of a live view: keys without echo, and its own state again at each end.

A signal that ends or stops the view would otherwise leave the shell without echo and cursor.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import termios
import time
import tty
from collections.abc import Iterator
from types import FrameType
from typing import IO, TYPE_CHECKING, Any, Final

from rich.live import Live

if TYPE_CHECKING:
    from typing_extensions import Self

#: Signals that end the view; Ctrl-C is an exception already.
_ENDING: Final = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Terminal:
    """Keys of a terminal; none if the standard input is not a terminal.

    Args:
        stdin: the standard input.
    """

    def __init__(self, stdin: IO[str]) -> None:
        self._descriptor = stdin.fileno() if stdin.isatty() else None

    def __enter__(self) -> Self:
        self._before = None if self._descriptor is None else termios.tcgetattr(self._descriptor)
        self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def key(self, seconds: float) -> str:
        """Return the key that is pressed within some seconds; "" if none is."""
        if self._descriptor is None:
            time.sleep(seconds)
            return ""
        ready, _, _ = select.select([self._descriptor], [], [], seconds)
        return os.read(self._descriptor, 1).decode(errors="replace") if ready else ""

    @contextlib.contextmanager
    def given_back(self, screen: Live) -> Iterator[None]:
        """Exit after a signal, and give the terminal back while Ctrl-Z stops the view."""

        def stop(number: int, _frame: FrameType | None) -> None:
            screen.console.show_cursor(True)
            self._end()
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)  # until `fg`
            signal.signal(number, stop)

        def go_on(_number: int, _frame: FrameType | None) -> None:
            self._begin()
            screen.console.show_cursor(False)
            screen.refresh()

        before: dict[int, Any] = {}
        handlers: dict[int, Any] = {
            signal.SIGTSTP: stop, signal.SIGCONT: go_on, **dict.fromkeys(_ENDING, _exit),
        }  # fmt: skip
        for number, handler in handlers.items():
            if signal.getsignal(number) is not signal.SIG_IGN:  # as by nohup
                before[number] = signal.signal(number, handler)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _begin(self) -> None:
        """Read keys without echo, if this program has the terminal."""
        if self._descriptor is None:
            return
        with contextlib.suppress(OSError):  # a terminal without jobs, in which nothing stops
            if os.tcgetpgrp(self._descriptor) != os.getpgrp():
                return
        with contextlib.suppress(termios.error):  # the terminal has gone
            tty.setcbreak(self._descriptor)  # Ctrl-C stays a signal

    def _end(self) -> None:
        if self._descriptor is not None and self._before is not None:
            with contextlib.suppress(termios.error):  # it has gone, which ends the view
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)


def _exit(number: int, _frame: FrameType | None) -> None:
    """Exit with the code by which a shell reports the end by this signal."""
    raise SystemExit(128 + number)
