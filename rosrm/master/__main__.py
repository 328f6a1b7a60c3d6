"""Entry point of the master's runtime, executed by `rosrm master` with checked settings.

This module imports neither pydantic nor typer nor rich, because the master's memory is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also during the imports
from __future__ import annotations

import gc
import signal

if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
gc.disable()  # a fifth of the start's CPU time; see `bootstrap.end_start`

import os

from rosrm.config.settings import ClusterConfig
from rosrm.runtime.bootstrap import Handover, ros_imported, run
from rosrm.runtime.crash_notes import kept_notes
from rosrm.runtime.process_end import end_process

with ros_imported("master"):
    from rosrm.ros.own_signals import own_signals
    from rosrm.ros.participant import Participant
    from rosrm.ros.peer_announcements import request_announcements


def serve(handover: Handover) -> int:
    """Join ROS and run the master; return the exit code."""
    config = ClusterConfig.from_json(handover.settings)
    own_signals()
    with Participant(config.ros, "rosrm_master") as participant:
        if not config.ros.interface_in_force():  # the request would leave by all interfaces
            request_announcements(participant.context.get_domain_id(), os.environ)
        # Imported only here, so that DDS discovers other participants during the imports.
        from rosrm.master.assembly import new_runtime  # noqa: PLC0415

        with kept_notes(config.state) as crashes:
            return new_runtime(config, handover, participant, crashes).run()


if __name__ == "__main__":
    end_process(run("master", serve))
