"""Ends what a slave that is gone left running on its host: `rosrm slave --stop-all` executes this.

It is the slave once more, which registers, accepts no work and ends. So the master learns what has
ended, as at the end of any slave. As `rosrm.slave`, it imports little.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also while the rest is being imported
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import sys
from dataclasses import replace

from rosrm.config.settings import HostConfig
from rosrm.extensions.registry import Registry
from rosrm.runtime.bootstrap import Handover, run
from rosrm.slave.runtime import SlaveRuntime


def serve(handover: Handover) -> int:
    """Take over what runs, and end it."""
    config = HostConfig.from_json(handover.settings)
    # Without probes, because nothing is measured: a probe that is broken must not prevent the end.
    ending = replace(config, on_stop="stop", probes={})
    return SlaveRuntime(ending, Registry.load(handover.plugins)).stop_all()


if __name__ == "__main__":
    sys.exit(run("slave", serve))
