"""Prefetch of short jobs: one assignment beyond `max_processes`, held by the slave.

Several messages pass between the end of one job and the start of the next. For a job of 0.1 s that
delay is long, so a host with `max_processes` may get one assignment more. Its supervisor or slave
starts that job without a further order as soon as a slot is free. A host gets it only if the mean
run times of earlier runs show that all of its running jobs end soon. A prefetched job that waits
longer than expected returns to its place in the queue.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import Instance
from rosrm.model.durations import LONGEST
from rosrm.model.values import InstanceState, InstanceStatus, Kind, ProcessSpec

#: Longest mean run time, in seconds, of a short job.
_SHORT: Final = 0.5
#: Run time, in seconds, after which a running job no longer counts as short.
PROVED_LONG: Final = 4 * _SHORT
#: Weight of the newest run in the mean.
_NEWEST: Final = 0.3


def learn_run_time(state: MasterState, spec: ProcessSpec, status: InstanceStatus) -> None:
    """Update the mean run time of a program with a job that has exited."""
    is_job = spec.kind is Kind.JOB and status.state is InstanceState.EXITED
    if is_job and 0.0 < status.run_time <= LONGEST:
        before = state.run_times.get(spec.program, status.run_time)
        state.run_times.put(spec.program, before + _NEWEST * (status.run_time - before))


def review_slots(state: MasterState, host: Host, now: float) -> None:
    """Allow a prefetched assignment on a host if all of its running jobs end soon."""
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


def waits_too_long(state: MasterState, instance: Instance, now: float) -> bool:
    """Return True if a prefetched assignment has waited longer than a short job runs.

    On a host that is not up it may have started, and an order to stop would not arrive.
    """
    return (
        instance.state is InstanceState.HELD
        and state.hosts.condition_of(instance.host) is HostCondition.UP
        and instance.host.description.max_processes > 0  # otherwise it waits for other starts
        and not instance.stopping
        and now - instance.since >= PROVED_LONG
    )
