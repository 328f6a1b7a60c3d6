"""Entry point of both runtimes: settings passed by a command, signals, logging, errors.

Settings and the list of plugins are passed on an inherited file descriptor.
"""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from rosrm.errors import ConfigError, RosrmError, ros_needed
from rosrm.extensions.installed import PluginAddress, installed_plugins
from rosrm.runtime import private_files
from rosrm.runtime.dispositions import handle
from rosrm.runtime.memory_file import memory_file
from rosrm.runtime.process_title import show_role
from rosrm.runtime.settings_check import SettingsSource
from rosrm.wording import printable

_OPTION: Final = "--settings-fd"
#: Thresholds of the garbage collector of a runtime.
_COLLECT_AT: Final = (10_000, 20, 20)


@dataclass(frozen=True, slots=True)
class Handover:
    """The input of a runtime.

    Attributes:
        settings: JSON of `ClusterConfig` or `HostConfig`.
        plugins: every installed plugin.
        source: origin of the settings, for a reload.
        parent: pid of the process with which the runtime ends; 0: none.
    """

    settings: str
    plugins: tuple[PluginAddress, ...]
    source: SettingsSource
    parent: int = 0


def hand_over(settings: str, source: SettingsSource, parent: int = 0) -> int:
    """Write the input of a runtime; return the file descriptor that the runtime is to inherit.

    Args:
        settings: JSON of the checked settings.
        source: origin of the settings.
        parent: pid of the parent, if the runtime ends with its parent; 0: it does not.
    """
    plugins = [[one.name, one.target, one.distribution] for one in installed_plugins()]
    handed = {
        "settings": settings, "plugins": plugins, "source": astuple(source), "parent": parent,
    }  # fmt: skip
    descriptor = memory_file("rosrm-settings", json.dumps(handed).encode())
    os.set_inheritable(descriptor, True)
    return descriptor


def command_line(module: str, descriptor: int) -> list[str]:
    """Return the command line of a runtime.

    Args:
        module: "rosrm.master" or another entry point.
        descriptor: as returned by `hand_over`.
    """
    return [sys.executable, *_without_this_folder(), "-m", module, _OPTION, str(descriptor)]


def _without_this_folder() -> list[str]:
    """Return the option that stops `-m` from searching the working directory first.

    In a checkout that search is needed, so the list is empty.
    """
    in_checkout = Path(__file__).is_relative_to(Path.cwd())
    return ["-P"] if sys.version_info >= (3, 11) and not in_checkout else []


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Block SIGINT while a runtime is started, so that it reaches the runtime's own handlers.

    Otherwise a Ctrl-C before the handlers are installed would print a traceback.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_over(words: Sequence[str]) -> Handover:
    """Read the input that the command passed; raise `ConfigError` for another command line."""
    if len(words) != 2 or words[0] != _OPTION:
        raise ConfigError(f"usage: {_OPTION} N; use `rosrm master` or `rosrm slave` to start one")
    with os.fdopen(int(words[1])) as source:
        handed = json.load(source)
    plugins = tuple(PluginAddress(*address) for address in handed["plugins"])
    return Handover(
        handed["settings"], plugins, SettingsSource(*handed["source"]), handed["parent"]
    )


_Handler = Callable[[int, FrameType | None], None]


def handle_signals(stop: _Handler, reload: _Handler | None = None) -> None:
    """Install the handlers of SIGINT and SIGTERM, which stop, and of SIGHUP.

    SIGHUP means that the terminal was closed, and stops, where the process has a controlling
    terminal. Elsewhere it reloads the settings. A signal that the starter ignores stays ignored.

    Args:
        stop: called for each signal to stop.
        reload: called for a SIGHUP without a terminal; None: `stop` is.
    """
    handle((signal.SIGINT, signal.SIGTERM), stop)
    # At the start, because a closed terminal is no controlling terminal any more.
    handle((signal.SIGHUP,), stop if reload is None or has_terminal() else reload)


def has_terminal() -> bool:
    """Return True if this process has a controlling terminal."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True


def end_start() -> None:
    """Exclude the objects of the start from garbage collection, and enable the collector.

    Those objects exist until the process ends. The start does not collect garbage before, because
    only 1 % of them are garbage, and the collection would take longer than the registration of all
    hosts. With Python's default thresholds a burst of submissions would take a third longer.
    """
    gc.freeze()
    gc.set_threshold(*_COLLECT_AT)
    gc.enable()


class LogFormatter(logging.Formatter):
    """Format of log lines without control characters, which messages may have from outside."""

    _second, _time = -1, ""

    def formatTime(  # noqa: N802
        self, record: logging.LogRecord, datefmt: str | None = None
    ) -> str:
        """Return the time, formatted once a second, because a burst of jobs logs many lines."""
        second = int(record.created)
        if second != self._second:
            self._second, self._time = second, super().formatTime(record, datefmt)
        return self._time

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """Return the line; further lines are indented, so that no message looks like two."""
        return super().formatMessage(record).replace("\n", "\n    ")

    def format(self, record: logging.LogRecord) -> str:
        """Return the line and its traceback, if any."""
        return printable(super().format(record))


def run(role: str, serve: Callable[[Handover], int]) -> int:
    """Read the input that the command passed, and serve; return the exit code.

    Args:
        role: "master" or "slave".
        serve: runs until a stop signal; the message of a `RosrmError` that it raises is printed.
    """
    private_files.set_private_umask()
    show_role(role)
    # The starting process blocked SIGINT (see `interrupts_held`); from now on it ends this one.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    output = logging.StreamHandler(sys.stderr)
    output.setFormatter(LogFormatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=logging.INFO, handlers=[output])
    try:
        handover = take_over(sys.argv[1:])
        if handover.parent:
            from rosrm.runtime.parent_death import end_with_parent  # noqa: PLC0415 - ctypes

            end_with_parent(handover.parent)
        return serve(handover)
    except RosrmError as error:
        return _report(role, error)


@contextlib.contextmanager
def ros_imported(role: str) -> Iterator[None]:
    """Return a context for the imports of a role that need ROS 2; exit if it cannot be imported."""
    try:
        with ros_needed():
            yield
    except RosrmError as error:
        sys.exit(_report(role, error))


def _report(role: str, error: RosrmError) -> int:
    """Print an error, and return the exit code."""
    sys.stderr.write(printable(f"rosrm {role}: {error}\n"))
    return error.exit_code
