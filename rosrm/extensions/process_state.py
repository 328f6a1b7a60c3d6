"""State of the process that plugins share with rosrm, and that rosrm relies on.

A plugin may change a signal's handler, the working directory, the umask or the logging: by mistake,
or because a library does so. rosrm restores them after each call in its main thread, and a part
does so once a second for what plugins do in threads.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final, cast

#: Signals that rosrm handles, or whose default action would end or stop it.
_SIGNALS: Final = (
    signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD, signal.SIGPIPE, signal.SIGALRM,
)  # fmt: skip
#: Signals whose handler a library in C may replace unseen by Python, as that of ROS does.
_OF_LIBRARIES: Final = (signal.SIGINT, signal.SIGTERM)


class ProcessState:
    """The state at the creation of this object, in the main thread."""

    __slots__ = (
        "_directory", "_disabled", "_handlers", "_level", "_log_handlers", "_settings", "_umask",
    )  # fmt: skip

    def __init__(self) -> None:
        root = logging.getLogger()
        self.keep_handlers()
        self._disabled, self._level = root.manager.disable, root.level
        self._log_handlers = root.handlers[:]
        self._settings = [read() for read, _, _ in _settings()]
        self._directory = _directory()
        self._umask = os.umask(0o077)
        os.umask(self._umask)

    def keep_handlers(self) -> None:
        """Take the present handlers of signals for the state."""
        self._handlers = [signal.getsignal(number) for number in _SIGNALS]

    def restore(self) -> list[str]:
        """Restore what has changed since; return what it was. No effect in another thread."""
        if threading.current_thread() is not threading.main_thread():
            return []
        changed = []
        for number, handler in zip(_SIGNALS, self._handlers, strict=True):
            is_other = signal.getsignal(number) != handler
            if handler is not None and (is_other or number in _OF_LIBRARIES):
                signal.signal(number, handler)
            if is_other:
                changed.append(f"the handler of {number.name}")
        root = logging.getLogger()
        if (root.manager.disable, root.level) != (self._disabled, self._level):
            root.manager.disable = self._disabled
            root.setLevel(self._level)
            changed.append("the level of the log")
        if root.handlers != self._log_handlers:
            root.handlers[:] = self._log_handlers
            changed.append("the handlers of the log")
        for (read, write, name), before in zip(_settings(), self._settings, strict=False):
            if read() != before:
                write(before)
                changed.append(name)
        if os.umask(self._umask) != self._umask:
            changed.append("the umask")
        if self._directory and _directory() != self._directory:
            with contextlib.suppress(OSError):  # removed
                os.chdir(self._directory)
            changed.append("the working directory")
        return changed


def _blocked() -> set[signal.Signals]:
    return cast("set[signal.Signals]", signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def _block(signals: set[signal.Signals]) -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, signals)


def _set_filters(filters: Sequence[Any]) -> None:
    warnings.filters[:] = filters  # type: ignore[index]


def _set_collecting(enabled: bool) -> None:
    (gc.enable if enabled else gc.disable)()


#: Further settings: how to read and to write them, and their names.
_SETTINGS: Final[tuple[tuple[Callable[[], Any], Callable[[Any], Any], str], ...]] = (
    (_blocked, _block, "the blocked signals"),
    (sys.getswitchinterval, sys.setswitchinterval, "the switch interval of threads"),
    (sys.getrecursionlimit, sys.setrecursionlimit, "the recursion limit"),
    (gc.isenabled, _set_collecting, "the garbage collection"),
    (lambda: list(warnings.filters), _set_filters, "the filters of warnings"),
    (socket.getdefaulttimeout, socket.setdefaulttimeout, "the time-out of sockets"),
)


def _settings() -> tuple[tuple[Callable[[], Any], Callable[[Any], Any], str], ...]:
    """Return the settings; that of numpy comes last, because a plugin may be the first to load it.

    Floating-point errors that raise would end a decision of the core itself.
    """
    numpy = sys.modules.get("numpy")
    if numpy is None or not hasattr(numpy, "geterr"):  # not there, or still being imported
        return _SETTINGS
    errors = (numpy.geterr, lambda before: numpy.seterr(**before), "the errors of numpy")
    return (*_SETTINGS, errors)


def _directory() -> str:
    try:
        return os.getcwd()  # noqa: PTH109 - called for each call of a plugin
    except OSError:  # removed
        return ""


class Interrupts:
    """Tells the user's Ctrl-C from a `KeyboardInterrupt` that a plugin raises itself.

    Only Python's own handler of SIGINT raises one: a master and a slave install others.
    """

    __slots__ = ("_watched", "pressed")

    def __init__(self) -> None:
        self.pressed = False
        self._watched = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._watched:
            signal.signal(signal.SIGINT, self._note)

    def _note(self, _number: int, _frame: Any) -> None:
        self.pressed = True
        raise KeyboardInterrupt

    def end(self) -> None:
        """Install the handler that was there before."""
        if self._watched:
            signal.signal(signal.SIGINT, signal.default_int_handler)
