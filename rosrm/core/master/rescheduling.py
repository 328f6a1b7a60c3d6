"""Reschedule: a process that has failed on one host starts on another one."""

from __future__ import annotations

from typing import Final

from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import Process
from rosrm.model.values import InstanceState, InstanceStatus

#: Ends after which another host may help; others have their own policy.
_FAILED: Final = (InstanceState.FAILED, InstanceState.EXITED)


def next_attempt(
    process: Process, host: Host, status: InstanceStatus, reason: str, now: float
) -> str:
    """Exclude the host on which a process has failed for good; return why it is queued again.

    Return "" if the process has no attempt left, and change nothing.
    """
    policy = process.spec.reschedule
    if status.state not in _FAILED or not policy.attempts:
        return ""
    if now - process.started_at >= process.spec.restart.window:
        process.reschedules = 0
        process.excluded.clear()
    if process.reschedules >= policy.attempts:
        return ""
    process.reschedules += 1
    process.queue_delay = policy.delay
    process.excluded[host.name] = f"{process.name} failed there: {reason}"
    process.demand = None
    attempt = f"attempt {process.reschedules} of {policy.attempts} on another host"
    return f"it failed on {host.name} ({reason}); {attempt} follows"
