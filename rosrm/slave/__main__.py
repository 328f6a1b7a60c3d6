"""Entry point of the slave's runtime, executed by `rosrm slave` with checked settings.

This module imports neither pydantic nor typer nor rich, because the slave's memory is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also during the imports
from __future__ import annotations

import gc
import signal

if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
gc.disable()  # a fifth of the start's CPU time; see `bootstrap.end_start`

import logging

from rosrm.config.settings import HostConfig
from rosrm.extensions.registry import SLAVE_KINDS, Registry
from rosrm.runtime import cgroups, oom_score
from rosrm.runtime.bootstrap import Handover, ros_imported, run
from rosrm.runtime.crash_notes import kept_notes
from rosrm.runtime.process_end import end_process
from rosrm.slave.own_key import wait_for_security

with ros_imported("slave"):
    from rosrm.ros.own_signals import own_signals
    from rosrm.slave.runtime import SlaveRuntime

_log = logging.getLogger("rosrm.slave")


def serve(handover: Handover) -> int:
    """Load the plugins and run the slave; return the exit code."""
    config = HostConfig.from_json(handover.settings)
    own_signals()
    fault = oom_score.protect()
    if fault:
        _log.info(
            "slave and supervisor are not protected from the OOM killer: %s. As root, with "
            "CAP_SYS_RESOURCE or with `OOMScoreAdjust=%d` of systemd they are",
            fault, oom_score.PROTECTED,
        )  # fmt: skip
    cgroups.delegate()  # first, because the supervisor inherits the group
    with kept_notes(config.state) as crashes:
        registry = Registry.load(handover.plugins, SLAVE_KINDS)
        registry.note_crashes(crashes)
        return SlaveRuntime(config, registry, wait_for_security(config), handover.source).run()


if __name__ == "__main__":
    end_process(run("slave", serve))
