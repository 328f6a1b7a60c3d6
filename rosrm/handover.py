"""What a command hands to the runtime that takes its place: checked settings, and the plugins.

It travels on an inherited file descriptor. Finding the installed plugins needs a good deal of the
standard library (entry points are e-mail headers in zip files and folders); that is done by the
command, so that a slave on a robot does not carry it.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from rosrm.errors import ConfigError

_OPTION: Final = "--settings-fd"


@dataclass(frozen=True, slots=True)
class PluginAddress:
    """Where an installed plugin is.

    Attributes:
        name: of its entry point.
        target: "module" or "module:object".
        distribution: name and version of the package that brings it.
    """

    name: str
    target: str
    distribution: str = ""


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
    from rosrm.installed import installed_plugins  # noqa: PLC0415 - see above

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
