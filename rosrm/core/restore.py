"""The state as the journal's intents have it, at the start of a master."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rosrm.core.hosts import HostCondition
from rosrm.core.specs import spec_from_dict
from rosrm.core.model import InstanceId
from rosrm.core.state import MasterState, Process, ProcessPhase, Wanted

_Table = Mapping[str, Mapping[str, Any]]
_WAITING = (ProcessPhase.QUEUED, ProcessPhase.SET_ASIDE)


def restore(state: MasterState, intents: Callable[[str], _Table], now: float) -> None:
    """Fill an empty state with what was intended.

    Nothing is started or stopped here: processes that run are expected on their hosts, and are
    compared with what those hold when their slaves register. A migration under way is not taken
    up again: the instance that owns the name, as committed or not, goes on; the other is stopped
    when its host is heard.

    Args:
        intents: the journal's table of a name.
    """
    by_id = sorted(intents("host").items(), key=lambda item: int(item[1]["host_id"]))
    for name, host in by_id:
        state.hosts.expect(name, cordoned=bool(host["cordoned"]))
    for program, amounts in intents("learned").items():
        state.learned.restore(program, amounts)
    stored = sorted(intents("process").values(), key=lambda item: int(item["order"]))
    for item in stored:
        _restore_process(state, item, now)
    state.next_order = 1 + max((int(item["order"]) for item in stored), default=0)
    numbers = intents("cluster").get("instances", {})
    state.next_instance = state.reserved_instances = int(numbers.get("next", 1))


def _restore_process(state: MasterState, item: Mapping[str, Any], now: float) -> None:
    phase = ProcessPhase(item["phase"])
    process = Process(
        spec_from_dict(item["spec"]), int(item["order"]), phase, now,
        wanted=Wanted(item["wanted"]), reason=item["reason"], excluded=dict(item["excluded"]),
        migrations=int(item["migrations"]), exit_code=int(item["exit_code"]),
        restarts=int(item["restarts"]),
    )  # fmt: skip
    state.processes[process.name] = process
    host = state.hosts.by_name.get(item["host"])
    if phase is ProcessPhase.QUEUED:
        state.queue.add(process.name, process.spec.priority, process.order)
    elif item["owner"] and host is not None:
        process.owner = int(item["owner"])
        state.add_instance(InstanceId(process.name, process.owner), process.spec, host, now)
        state.set_phase(
            process, ProcessPhase.UNREACHABLE, now,
            f"{host.name} has not come back since the master started",
        )  # fmt: skip
        if state.hosts.condition_of(host) is not HostCondition.EXPECTED:
            raise AssertionError("a host is up before any was heard")
    elif not phase.over and phase not in _WAITING:
        process.wanted = Wanted.RUN
        state.enqueue(process, now, "its host is not known any more")
