"""The entry of both runtimes: settings handed over by a command, signals, logging, errors.

Settings and the list of plugins travel on an inherited file descriptor.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Final

from rosrm.errors import ConfigError, RosrmError
from rosrm.extensions.installed import PluginAddress, installed_plugins

_OPTION: Final = "--settings-fd"


@dataclass(frozen=True, slots=True)
class Handover:
    """What a runtime begins with.

    Attributes:
        settings: JSON of `ClusterConfig` or `HostConfig`.
        plugins: every installed plugin.
    """

    settings: str
    plugins: tuple[PluginAddress, ...]


def hand_over(settings: str) -> int:
    """Write what the runtime begins with; returns a file descriptor that it is to inherit.

    Args:
        settings: JSON of the checked settings.
    """
    plugins = [[one.name, one.target, one.distribution] for one in installed_plugins()]
    descriptor = os.memfd_create("rosrm-settings", 0)
    os.write(descriptor, json.dumps({"settings": settings, "plugins": plugins}).encode())
    os.lseek(descriptor, 0, os.SEEK_SET)
    return descriptor


def arguments(descriptor: int) -> list[str]:
    """The runtime's command line."""
    return [_OPTION, str(descriptor)]


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Within, a runtime is started: until it has its own handlers, a Ctrl-C is kept for it.

    Else Python, which handles it from its first moment on, would answer with a traceback.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_over(command_line: Sequence[str]) -> Handover:
    """Read what the command handed over; raises `ConfigError` for another command line."""
    if len(command_line) != 2 or command_line[0] != _OPTION:
        raise ConfigError(f"usage: {_OPTION} N; use `rosrm master` or `rosrm slave` to start one")
    with os.fdopen(int(command_line[1])) as source:
        told = json.load(source)
    plugins = tuple(PluginAddress(*address) for address in told["plugins"])
    return Handover(told["settings"], plugins)


def handle_stop_signals(handler: Callable[[int, FrameType | None], None]) -> None:
    """Have SIGINT, SIGTERM and SIGHUP (the terminal was closed) handled alike.

    A SIGHUP that is ignored, as by `nohup`, stays ignored.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def run(role: str, serve: Callable[[Handover], int]) -> int:
    """Take over what the command handed over, and serve; returns the exit code.

    Args:
        role: "master" or "slave".
        serve: runs until it is told to stop; what it raises for the user is printed.
    """
    # Who started us held them back (see `interrupts_held`); by now they end us without a word.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s",
        datefmt="%H:%M:%S",
    )  # fmt: skip
    try:
        return serve(take_over(sys.argv[1:]))
    except RosrmError as error:
        sys.stderr.write(f"rosrm {role}: {error}\n")
        return error.exit_code
