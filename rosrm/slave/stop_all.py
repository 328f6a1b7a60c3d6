"""Entry point of `rosrm slave --stop-all`: stops the processes that a former slave left running.

A new slave registers, accepts no work and ends. So the master receives the ends of the processes,
as at the end of any slave. Like `rosrm.slave`, this module imports little.
"""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import sys
from dataclasses import replace

from rosrm.config.settings import HostConfig
from rosrm.extensions.registry import SLAVE_KINDS, Registry
from rosrm.keys.finding import host_security
from rosrm.runtime.bootstrap import Handover, run
from rosrm.slave.own_key import security_without_key
from rosrm.slave.runtime import SlaveRuntime


def serve(handover: Handover) -> int:
    """Re-adopt the running processes and stop them; return the exit code."""
    config = HostConfig.from_json(handover.settings)
    # Without probes, so that a broken probe cannot prevent the end; readings are not needed.
    ending = replace(config, on_stop="stop", probes={})
    host = config.host
    security = host_security(config.security, host) or security_without_key(host)
    registry = Registry.load(handover.plugins, SLAVE_KINDS)
    return SlaveRuntime(ending, registry, security, handover.source).stop_all()


if __name__ == "__main__":
    sys.exit(run("slave", serve))
