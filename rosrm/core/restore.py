"""The state as the journal's intents have it, at the start of a master."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rosrm.core.lifecycle import adopt_to_stop
from rosrm.core.model import InstanceId
from rosrm.core.specs import spec_from_dict
from rosrm.core.state import MasterState, Process, ProcessPhase, Wanted
from rosrm.ports import Intent

_Table = Mapping[str, Mapping[str, Any]]


def restore(state: MasterState, intents: Callable[[str], _Table], now: float) -> None:
    """Fill an empty state with what was intended.

    Nothing is started or stopped here: processes that run are expected on their hosts, and are
    compared with what those hold when their slaves register. A migration under way is not taken
    up again: the instance that owns the name, as committed or not, goes on; the other is stopped
    when its host is heard.

    `intents` gives the journal's table of a name.
    """
    by_id = sorted(intents("host").items(), key=lambda item: int(item[1]["host_id"]))
    for name, host in by_id:
        state.hosts.expect(
            name, now, cordoned=bool(host["cordoned"]), draining=bool(host.get("draining"))
        )
    for program, amounts in intents("learned").items():
        state.learned.restore(program, amounts)
    stored = sorted(intents("process").values(), key=lambda item: int(item["order"]))
    for item in stored:
        _restore_process(state, item, now)
    state.next_order = 1 + max((int(item["order"]) for item in stored), default=0)
    numbers = intents("cluster").get("instances", {})
    state.next_instance = state.reserved_instances = int(numbers.get("next", 1))
    for name, move in intents("migration").items():
        _forget_move(state, name, move)


def _restore_process(state: MasterState, item: Mapping[str, Any], now: float) -> None:
    phase = ProcessPhase(item["phase"])
    process = Process(
        spec_from_dict(item["spec"]), int(item["order"]), phase, now,
        wanted=Wanted(item["wanted"]), reason=item["reason"], excluded=dict(item["excluded"]),
        migrations=int(item["migrations"]), exit_code=int(item["exit_code"]),
        restarts=int(item["restarts"]),
    )  # fmt: skip
    state.processes[process.name] = process
    _restore_instances(state, process, item, now)
    if phase is ProcessPhase.QUEUED:
        state.queue.add(process.name, process.spec.priority, process.order)
    elif phase is ProcessPhase.SET_ASIDE:
        state.set_aside.add(process.name)
    elif not phase.over:
        _expect_to_run(state, process, now)


def _restore_instances(
    state: MasterState, process: Process, item: Mapping[str, Any], now: float
) -> None:
    """Put on the books what may still run: the owner to go on, any other to be stopped."""
    for number, host_name in item["instances"].items():
        host = state.hosts.by_name.get(host_name)
        if host is None:
            continue
        instance = InstanceId(process.name, int(number))
        if instance.number == item["owner"]:
            process.owner = instance.number
            state.add_instance(instance, process.spec, host, now)
        else:
            adopt_to_stop(state, instance, host, now)


def _expect_to_run(state: MasterState, process: Process, now: float) -> None:
    owner = state.instances.get(process.owner)
    if owner is not None:
        reason = f"{owner.host.name} has not come back since the master started"
        state.set_phase(process, ProcessPhase.UNREACHABLE, now, reason)
    elif process.wanted is Wanted.CANCEL:
        state.set_phase(process, ProcessPhase.CANCELLED, now)
    elif process.instances:
        process.wanted = Wanted.REQUEUE
        left = ", ".join(f"{one.id} on {one.host.name}" for one in state.instances_of(process))
        state.set_phase(process, ProcessPhase.STOPPING, now, f"waits for the end of {left}")
    else:
        state.enqueue(process, now, "nothing of it was left when the master started")


def _forget_move(state: MasterState, name: str, move: Mapping[str, Any]) -> None:
    """A move that was under way is over; its source may have been told to stop already."""
    process = state.processes.get(name)
    source = state.instances.get(int(move["source"]))
    if process is not None and source is not None and process.owner == source.id.number:
        source.recalled = True
    state.emit(Intent("migration", name, None))
