"""Without further changes no process waits for what is free, or holds what it cannot use."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master.assignment.gang_search import Blocked, find_places
from rosrm.core.master.assignment.gangs import members_of
from rosrm.core.master.invariants import check
from rosrm.core.master.state.process import Process, ProcessPhase
from rosrm.model.arrays import NO_ARRAY, ArrayMembership
from rosrm.model.schedules import NO_SCHEDULE, Schedule
from rosrm.model.values import (
    Kind,
    NeighbourRule,
    ProcessSpec,
    ReschedulePolicy,
    StartOrder,
)
from tests.unit.core.cluster import Cluster, process
from tests.unit.core.test_gangs import machine

NAMES = [f"p{at}" for at in range(7)]
HOSTS = ("a", "b")
#: Seconds after which each delay has ended.
LONG = 10.0


bounds = st.sampled_from([1, 1, 2])
changes = st.sampled_from(
    ["submit", "submit", "submit", "end", "end", "fail", "cancel", "restart", "cordon", "uncordon",
     "drain", "master"],
)  # fmt: skip


def spec(name: str, known: dict[str, ProcessSpec], data: st.DataObject) -> ProcessSpec:
    """Return a process that may wait for known ones, for places, a gang, a delay or room."""
    draw = data.draw
    order, near = StartOrder(), ()
    wait = draw(st.sampled_from(["", "", "after", "near"])) if known else ""
    if wait:
        other = known[draw(st.sampled_from(sorted(known)))]
        ends = other.kind is Kind.JOB and not other.schedule
        if wait == "after":
            condition = draw(st.sampled_from(["ready", "finished"])) if ends else "ready"
            order = StartOrder({other.name: condition})
        else:
            near = (NeighbourRule("near", (other.name,)),)
    is_job = draw(st.integers(0, 3)) > 0
    array = ArrayMembership(draw(st.sampled_from("rrs")), NAMES.index(name), draw(bounds))
    schedule = Schedule(every=1e6) if is_job and not draw(st.integers(0, 9)) else NO_SCHEDULE
    return process(
        name, memory=draw(st.sampled_from([0, 0, 300, 500])), start_order=order, neighbours=near,
        kind=Kind.JOB if is_job else Kind.SERVICE,
        array=array if is_job and draw(st.booleans()) else NO_ARRAY,
        together=draw(st.sampled_from(["", "", "", "g", "h"])),
        priority=draw(st.sampled_from([0, 0, 0, 5])), schedule=schedule,
        reschedule=ReschedulePolicy(draw(st.integers(0, 2)), draw(st.sampled_from([0.0, 4.0]))),
    )  # fmt: skip


def act(cluster: Cluster, change: str, data: st.DataObject) -> None:
    if change == "submit":
        names = data.draw(st.lists(st.sampled_from(NAMES), min_size=2, max_size=5, unique=True))
        every = cluster.state.processes
        known = {one.name: one.spec for one in every.values() if not one.phase.is_terminal}
        specs = {}
        for name in names:
            if name not in known:
                known[name] = specs[name] = spec(name, known, data)
        cluster.submit(*specs.values())
    elif change in ("end", "fail"):
        name = data.draw(st.sampled_from(NAMES))
        where = cluster.where(name) if name in cluster.state.processes else []
        if where:
            cluster.finish(name, on=where[0], code=int(change == "fail"))
    elif change in ("cancel", "restart"):
        name = data.draw(st.sampled_from(NAMES))
        cluster.cancel(name) if change == "cancel" else cluster.restart(name)
    elif change == "master":
        cluster.restart_master()
    else:
        cluster.set_host(data.draw(st.sampled_from(HOSTS)), change)
    cluster.wait(0.3)


@given(
    data=st.data(), backfill=st.booleans(), preemption=st.sampled_from(["", "requeue"]),
    number=st.integers(2, 14),
)  # fmt: skip
def test_no_process_waits_for_what_is_free(
    data: st.DataObject, backfill: bool, preemption: str, number: int
) -> None:
    """Arrays, gangs, start orders, neighbours, delays, drains, schedules and room, in any order."""
    cluster = Cluster(
        *map(machine, HOSTS), backfill=backfill, preemption=preemption, hysteresis=0.5, settle=1.0
    )
    for _ in range(number):
        act(cluster, data.draw(changes), data)
    cluster.wait(LONG, tick=0.5)
    check(cluster.state)
    waiting_for_room = False
    closed = set[tuple[str, str]]()
    queued = [one for one in cluster.state.processes.values() if one.phase is ProcessPhase.QUEUED]
    for one in sorted(queued, key=lambda one: (-one.spec.priority, one.order)):
        members = members_of(cluster.state, one)
        if any(awaits_another(cluster, mate, members) for mate in members):
            continue
        lacking = arrays_without_place(cluster, members)
        if lacking or closed.intersection(arrays_of(members)):
            if len(members) > 1 and not backfill:
                closed.update(arrays_of(members))
            continue
        found = find_places(cluster.state, members)
        assert isinstance(found, Blocked) or waiting_for_room, f"{one.name} waits: {one.reason}"
        waiting_for_room = waiting_for_room or not backfill
    for name, room in cluster.state.preemption.room_made.items():
        assert room.host is None or name in cluster.state.queue


def arrays_of(members: list[Process]) -> Counter[tuple[str, str]]:
    return Counter((one.principal, one.spec.array.name) for one in members if one.spec.array.name)


def arrays_without_place(cluster: Cluster, members: list[Process]) -> list[str]:
    """Return the arrays with fewer places than some processes need at once."""
    number = arrays_of(members)
    running = arrays_of([one for one in cluster.state.processes.values() if one.instances])
    return [
        one.spec.array.name for one in members
        if (array := (one.principal, one.spec.array.name)) in number
        and one.spec.array.parallel and running[array] + number[array] > one.spec.array.parallel
    ]  # fmt: skip


def awaits_another(cluster: Cluster, one: Process, members: list[Process]) -> bool:
    """Return True if a process waits for another one, or is not in the queue with its gang."""
    if one.phase is not ProcessPhase.QUEUED or one.placed_from > cluster.now:
        return True
    for name, condition in one.spec.start_order.after.items():
        other = cluster.state.processes.get(name)
        if other is None:
            return True
        done = other.phase is ProcessPhase.FINISHED
        done = done and (other.spec.kind is Kind.JOB or condition == "finished")
        if not done and not (condition == "ready" and other.phase is ProcessPhase.RUNNING):
            return True
    mates = {mate.name for mate in members}
    near = [name for rule in one.spec.neighbours for name in rule.processes if name not in mates]
    return any(name not in cluster.state.processes or not cluster.where(name) for name in near)
