"""Protection of the signal handlers of a part of rosrm from `rclpy.init` of a plugin."""

from __future__ import annotations

from typing import Any

import rclpy


def own_signals() -> None:
    """Keep `rclpy.init` of a plugin from installing handlers of SIGINT and SIGTERM.

    They would shut down all contexts of this process at a signal, also those of rosrm, which could
    then neither stop its processes nor say that it ends. Call this in a master and a slave alone:
    elsewhere the process is the user's.
    """
    found: Any = rclpy
    found.install_signal_handlers = found.uninstall_signal_handlers = _nothing
    found.signals.install_signal_handlers = found.signals.uninstall_signal_handlers = _nothing


def _nothing(*_: object) -> None:
    """Do nothing."""
