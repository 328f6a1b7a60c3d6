"""Reschedule: a process that has failed on one host starts on another one."""

from __future__ import annotations

from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import Failure, Process
from rosrm.model.values import InstanceState, InstanceStatus, Kind
from rosrm.wording import first_line, listed

#: Ends after which another host may help; others have their own policy.
_FAILED: Final = (InstanceState.FAILED, InstanceState.EXITED)


def next_attempt(process: Process, host: Host, status: InstanceStatus, reason: str) -> str:
    """Exclude the host on which a process has failed for good; return why it is queued again.

    Return "" if the process has no attempt left, and change nothing.
    """
    policy = process.spec.reschedule
    if status.state not in _FAILED or not policy.attempts:
        return ""
    note_run(process, status)
    if process.reschedules >= policy.attempts:
        return ""
    process.reschedules += 1
    process.queue_delay = policy.delay
    process.failed_on[host.name] = Failure(reason, host.description.incarnation)
    process.demand = None
    attempt = f"attempt {process.reschedules} of {policy.attempts} on another host"
    return f"it failed on {host.name} ({reason}); {attempt} follows"


def note_run(process: Process, status: InstanceStatus) -> None:
    """Give a service all attempts again if its last run was as long as `restart.window`.

    The time since its start does not count: it is long after many short runs, too. The attempts of
    a job are never renewed, because each of its runs begins the same work again.
    """
    is_job, window = process.spec.kind is Kind.JOB, process.spec.restart.window
    if process.reschedules and not is_job and status.run_time >= window:
        forget_failures(process)


def forget_failures(process: Process) -> None:
    """Give a process all attempts again, on every host."""
    process.reschedules, process.queue_delay = 0, 0.0
    process.failed_on.clear()
    process.demand = None


def allow_every_host(process: Process) -> None:
    """Let a process start on the hosts again that have refused it or on which it failed."""
    process.excluded.clear()
    process.refusals.clear()
    process.moves.clear()
    forget_failures(process)


def review_refusals(state: MasterState, now: float) -> None:
    """Let processes be started on, or moved to, hosts that have refused them long enough ago."""
    for process in state.processes.values():
        if not process.excluded or process.phase.is_terminal:
            continue
        waiting = process.refusals.waiting(now)
        for host in [one for one in process.excluded if one not in waiting]:
            del process.excluded[host]
            process.demand = None
            state.queue.version += 1
            state.save(process)


def failures(process: Process) -> str:
    """Return a phrase on the hosts that are excluded because a process failed there; "": none."""
    failed = process.failed_on.items()
    return listed(f"{host} ({first_line(one.reason)})" for host, one in failed) if failed else ""
