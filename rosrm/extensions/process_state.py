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

# Without the conversion to enumerations, which takes most of the time of `signal`.
from _signal import getsignal  # type: ignore[import-not-found]
from _signal import signal as install
from collections.abc import Callable
from typing import Any, Final

from rosrm.wording import sanitized

#: Signals that rosrm handles, or whose default action would end or stop it.
_SIGNALS: Final = (
    signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD, signal.SIGPIPE, signal.SIGALRM,
)  # fmt: skip
#: Signals whose handler a library in C may replace unseen by Python, as that of ROS does.
_OF_LIBRARIES: Final = (signal.SIGINT, signal.SIGTERM)


#: Contents of `os.environ`. A copy is one step, which no thread of a plugin can divide; a copy of
#: `os.environ` itself fails with `KeyError` if a thread removes a variable during it.
_VARIABLES: Final[dict[bytes, bytes]] = vars(os.environb)["_data"]
#: Maximum number of environment variables in a warning, and of characters of each.
_NAMED: Final = 3
_LONGEST_NAME: Final = 100


class ProcessState:
    """The state at the creation of this object, in the main thread.

    Args:
        whole: True: also what only the kernel knows, by some system calls. A decision may call
            a plugin hundreds of times, so the runtimes restore this part once a second.
    """

    __slots__ = (
        "_blocked", "_collects", "_directory", "_disabled", "_environment", "_handlers", "_level",
        "_log_handlers", "_settings", "_umask", "_whole",
    )  # fmt: skip

    def __init__(self, *, whole: bool = True) -> None:
        root = logging.getLogger()
        self._whole = whole
        self.keep_own()
        self._disabled, self._level = root.manager.disable, root.level
        self._log_handlers = root.handlers[:]
        self._settings = [read() for read, _, _ in _settings()]
        if whole:
            self._blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
            self._directory = _directory()
            self._umask = os.umask(0o077)
            os.umask(self._umask)

    def keep_own(self) -> None:
        """Adopt the changes by rosrm itself: handlers, environment, garbage collection."""
        self._handlers = [getsignal(number) for number in _SIGNALS]
        self._collects = gc.isenabled(), gc.get_threshold()
        self._environment = _VARIABLES.copy() if self._whole else {}

    def restore(self) -> list[str]:
        """Restore changed state, and return its names; do nothing in another thread."""
        if threading.current_thread() is not threading.main_thread():
            return []
        changed = []
        for number, handler in zip(_SIGNALS, self._handlers, strict=True):
            is_other = getsignal(number) is not handler  # it may be a plugin's, with any `__eq__`
            if handler is not None and (is_other or (self._whole and number in _OF_LIBRARIES)):
                install(number, handler)
            if is_other:
                changed.append(f"the handler of {number.name}")
        root = logging.getLogger()
        if (root.manager.disable, root.level) != (self._disabled, self._level):
            root.manager.disable = self._disabled
            root.setLevel(self._level)
            changed.append("the level of the log")
        if root.handlers != self._log_handlers:
            root.handlers = self._log_handlers[:]
            changed.append("the handlers of the log")
        for (read, write, name), before in zip(_settings(), self._settings, strict=False):
            if read() != before:
                write(before)
                changed.append(name)
        if (gc.isenabled(), gc.get_threshold()) != self._collects:
            enabled, thresholds = self._collects
            gc.set_threshold(*thresholds)
            (gc.enable if enabled else gc.disable)()
            changed.append("the garbage collection")
        return changed + (self._restore_of_kernel() if self._whole else [])

    def _restore_of_kernel(self) -> list[str]:
        changed = []
        if signal.pthread_sigmask(signal.SIG_BLOCK, ()) != self._blocked:
            signal.pthread_sigmask(signal.SIG_SETMASK, self._blocked)
            changed.append("the blocked signals")
        if os.umask(self._umask) != self._umask:
            changed.append("the umask")
        if self._directory and _directory() != self._directory:
            with contextlib.suppress(OSError):  # removed
                os.chdir(self._directory)
            changed.append("the working directory")
        changed += self._restore_environment()
        silenced = [one for one in _own_logs() if one.disabled]  # `dictConfig` does so by default
        for one in silenced:
            one.disabled = False
        if silenced:
            changed.append("the loggers of rosrm")
        return changed

    def _restore_environment(self) -> list[str]:
        """Restore the variables, which each process of a slave and its supervisor would get."""
        before, after = self._environment, _VARIABLES.copy()
        if before == after:
            return []
        names = sorted({name for name, _ in before.items() ^ after.items()})
        for name in names:
            if name in before:
                os.environb[name] = before[name]
                continue
            with contextlib.suppress(KeyError):  # a thread has removed it since
                del os.environb[name]
        shown = (sanitized(os.fsdecode(name), _LONGEST_NAME) for name in names[:_NAMED])
        return [f"the environment variable {name}" for name in shown]


def _own_logs() -> list[logging.Logger]:
    loggers = list(logging.root.manager.loggerDict.items())
    return [
        one for name, one in loggers if isinstance(one, logging.Logger) and name.startswith("rosrm")
    ]


def _raised_warnings() -> list[Any]:
    """Return the filters by which a warning is raised, also in a decision of the core itself."""
    return [one for one in warnings.filters if one[0] == "error"]


def _raise_warnings(before: list[Any]) -> None:
    kept = [one for one in warnings.filters if one[0] != "error" or one in before]
    warnings.resetwarnings()  # so that no warning remembers the filters of before
    warnings.filters[:] = kept  # type: ignore[index]


#: Further settings: how to read and to write them, and their names.
_SETTINGS: Final[tuple[tuple[Callable[[], Any], Callable[[Any], Any], str], ...]] = (
    (sys.getswitchinterval, sys.setswitchinterval, "the switch interval of threads"),
    (sys.getrecursionlimit, sys.setrecursionlimit, "the recursion limit"),
    (socket.getdefaulttimeout, socket.setdefaulttimeout, "the time-out of sockets"),
    (gc.get_debug, gc.set_debug, "the debugging of the garbage collection"),
    (_raised_warnings, _raise_warnings, "which warnings raise"),
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
    """Distinguishes the user's Ctrl-C from a `KeyboardInterrupt` that a plugin raises.

    Only Python's own handler of SIGINT raises one: a master and a slave install others.
    """

    __slots__ = ("_watched", "pressed")

    def __init__(self) -> None:
        self.pressed = False
        self._watched = getsignal(signal.SIGINT) is signal.default_int_handler
        if self._watched:
            install(signal.SIGINT, self._note)

    def _note(self, _number: int, _frame: Any) -> None:
        self.pressed = True
        raise KeyboardInterrupt

    def end(self) -> None:
        """Install the handler that was there before."""
        if self._watched:
            install(signal.SIGINT, signal.default_int_handler)
