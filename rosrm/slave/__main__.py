"""Starts the slave's runtime from settings that were checked before: `rosrm slave` executes this.

It imports neither pydantic nor typer nor rich: the memory of a slave is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also while the rest is being imported
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import sys

from rosrm.config.settings import HostConfig
from rosrm.extensions.registry import Registry
from rosrm.runtime.bootstrap import Handover, run
from rosrm.slave.runtime import SlaveRuntime


def serve(handover: Handover) -> int:
    """Load the plugins and be the slave."""
    config = HostConfig.from_json(handover.settings)
    return SlaveRuntime(config, Registry.load(handover.plugins)).run()


if __name__ == "__main__":
    sys.exit(run("slave", serve))
