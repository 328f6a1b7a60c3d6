"""Starts the slave's runtime from settings that were checked before: `rosrm slave` executes this.

It imports neither pydantic nor typer nor rich: the memory of a slave is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also while the rest is being imported
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import logging
import sys

from rosrm.config.settings import HostConfig
from rosrm.errors import RosrmError
from rosrm.handover import take_over
from rosrm.registry import Registry
from rosrm.slave.runtime import SlaveRuntime


def main() -> int:
    """Read the settings from an inherited file descriptor and serve; returns the exit code."""
    handover = take_over(sys.argv[1:])
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s",
        datefmt="%H:%M:%S",
    )  # fmt: skip
    config = HostConfig.from_json(handover.settings)
    try:
        return _serve(config, Registry.load(handover.plugins))
    except RosrmError as error:
        sys.stderr.write(f"rosrm slave: {error}\n")
        return error.exit_code


def _serve(config: HostConfig, registry: Registry) -> int:
    return SlaveRuntime(config, registry).run()


if __name__ == "__main__":
    sys.exit(main())
