"""Prefetch of short jobs: one assignment beyond `max_processes`, held by the slave.

Between the end of one job and the start of the next lie several messages, which is much for a job
of 0.1 s. So a host with `max_processes` may get one assignment more. Its slave holds that job and
starts it without a further order as soon as a slot is free. Prefetch needs run times of earlier
runs of the same program, so that no job waits long behind a long one. A job that waits longer than
expected all the same returns to its place in the queue.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import Instance
from rosrm.model.values import LONGEST_TIME, InstanceState, InstanceStatus, Kind, ProcessSpec

#: Seconds: jobs that run no longer than this on average are short.
_SHORT: Final = 0.5
#: Seconds after which a job that was thought short has proved otherwise.
PROVED_LONG: Final = 4 * _SHORT
#: Weight of the newest run in the mean.
_NEWEST: Final = 0.3


def learn_run_time(state: MasterState, spec: ProcessSpec, status: InstanceStatus) -> None:
    """Update the mean run time of a program with a job that has exited."""
    is_job = spec.kind is Kind.JOB and status.state is InstanceState.EXITED
    if is_job and 0.0 < status.run_time <= LONGEST_TIME:
        before = state.run_times.get(spec.program, status.run_time)
        state.run_times[spec.program] = before + _NEWEST * (status.run_time - before)


def review_slots(state: MasterState, host: Host, now: float) -> None:
    """Allow or forbid the prefetched assignment of a host whose processes have changed."""
    most = host.description.max_processes
    if not most:
        return
    running = [instance for instance in state.instances_of(host) if instance.is_running]
    ahead = len(running) >= most and all(_ends_soon(state, one, now) for one in running)
    state.hosts.set_bound(host, most + ahead)


def _ends_soon(state: MasterState, instance: Instance, now: float) -> bool:
    process = state.processes.get(instance.id.process)
    if process is None or process.spec.kind is not Kind.JOB:
        return False
    expected = state.run_times.get(process.spec.program)
    return expected is not None and expected <= _SHORT and now - instance.since < PROVED_LONG


def waits_too_long(instance: Instance, now: float) -> bool:
    """Return True if a prefetched assignment waits for a job that turned out to be long."""
    return (
        instance.state is InstanceState.HELD
        and instance.host.description.max_processes > 0  # otherwise it waits for other starts
        and not instance.stopping
        and now - instance.since >= PROVED_LONG
    )
