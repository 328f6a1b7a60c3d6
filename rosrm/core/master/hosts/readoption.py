"""Re-adoption of instances that were given up with their lost host, after it rejoins.

If no successor has started, the instance owns the name again, and its process leaves the queue; a
job that has completed in between is complete. If a successor has started, the instance is fenced.
An instance of another version than the desired one counts as that version, and is then replaced.
"""

from __future__ import annotations

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.process import (
    WAITING,
    LeftBehind,
    PendingAmendment,
    Process,
    ProcessPhase,
)
from rosrm.core.master.state.spec_changes import with_in_place
from rosrm.model.event_kinds import EventKind
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus


def readopt_all(state: MasterState, host: Host, now: float) -> None:
    """Re-adopt every instance of a host without a successor, until the host reports otherwise."""
    for name in [*state.queue, *sorted(state.set_aside)]:
        process = state.processes[name]
        if process.left_behind is not None and process.left_behind.host == host.name:
            _readopt(state, process, process.left_behind, host, now)


def readopt(state: MasterState, host: Host, status: InstanceStatus, now: float) -> bool:
    """Re-adopt one reported instance that was given up; return False if that is impossible."""
    process = state.processes.get(status.instance.process)
    left = None if process is None else process.left_behind
    if process is None or left is None or process.phase not in WAITING:
        return False
    if (left.number, left.host) != (status.instance.number, host.name):
        return False
    _readopt(state, process, left, host, now)
    return True


def _readopt(
    state: MasterState, process: Process, left: LeftBehind, host: Host, now: float
) -> None:
    state.unqueue(process)
    spec = process.spec if left.spec is None else with_in_place(left.spec, process.spec)
    if spec != process.spec:
        state.set_spec(process, spec)
        application = state.applications.get(spec.application)
        if application is not None:
            application.reopen(process.name)
            state.save_application(application)
    again = InstanceId(process.name, left.number)
    instance = state.add_instance(again, spec, host, now, state.estimate(spec))
    # Unlike a new assignment, the instance has a state. So it is dropped if the host does not
    # report it.
    instance.node_name, instance.state = left.node_name, InstanceState.RUNNING
    instance.restarts_off = left.restarts_off
    process.owner, process.left_behind = left.number, None
    process.began = left.began
    state.set_phase(process, ProcessPhase.STARTING, now)
    state.record(
        now, EventKind.READOPTED, f"{host.name} reports again: {instance.id} still runs there",
        process=process.name, host=host.name, facts={"number": left.number},
    )  # fmt: skip
    # Its application may have changed since, and its slave may apply another restart policy.
    state.unamended[process.name] = PendingAmendment()
    state.save(process)


def has_successor(state: MasterState, status: InstanceStatus) -> bool:
    """Return True if another instance owns the name of this one, or is about to.

    True also where a plan treats this instance as ended, or its image owns the name.
    """
    process = state.processes.get(status.instance.process)
    number, migration = status.instance.number, state.migrations.get(status.instance.process)
    if migration is not None and number in migration.ended:
        return True
    if process is None:
        return False
    return process.owner not in (0, number) or process.image is not None
