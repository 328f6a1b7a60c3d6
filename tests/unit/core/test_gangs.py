"""Gangs: processes that are placed in one decision, or wait together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.assignment.gang_search import Blocked, find_places
from rosrm.core.master.assignment.gangs import members_of
from rosrm.core.master.commands import Assign, Command
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.preemption import preempt
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.requester import Requester
from rosrm.model.values import HostLossPolicy, NeighbourRule, ProcessSpec, StartOrder
from tests.unit.core.cluster import MIB, Cluster, Machine, job, movable, process


def machine(name: str, used: float = 0.0, memory: float = 1000.0, **fields: Any) -> Machine:
    """Return a host with 1000 MiB, 80 % of which may be used."""
    return Machine(name, memory=memory * MIB, busy={"memory": used, "cpu": 0.0}, **fields)


def cluster_of(hosts: str, **fields: Any) -> Cluster:
    return Cluster(*map(machine, hosts), hysteresis=0.5, settle=1.0, **fields)


def gang(*memory: float, name: str = "sensing", **fields: Any) -> list[ProcessSpec]:
    """Return the processes of a gang, named after it, by their needs in MiB."""
    return [
        process(f"{name}-{number}", memory=one, together=name, **fields)
        for number, one in enumerate(memory)
    ]


def phases(cluster: Cluster, name: str = "sensing") -> list[str]:
    return [
        one.phase.value for one in cluster.state.processes.values() if one.spec.together == name
    ]


def steps_with_assignments(cluster: Cluster) -> list[set[str]]:
    """Return the list to which each later step adds the names that it assigns."""
    steps: list[set[str]] = []

    def watch(commands: Sequence[Command]) -> None:
        given = [one for one in commands if isinstance(one, Assign)]
        if given:
            steps.append({one.assignment.instance.process for one in given})

    cluster.watch = watch
    return steps


# --- all or none ------------------------------------------------------------------------------


def test_all_processes_of_a_gang_are_assigned_in_one_step() -> None:
    """One host may take several of them."""
    cluster = cluster_of("ab")
    steps = steps_with_assignments(cluster)
    cluster.submit(*gang(300, 300, 300, 300))
    assert steps == [{"sensing-0", "sensing-1", "sensing-2", "sensing-3"}]
    assert phases(cluster) == ["running"] * 4


def test_a_gang_without_room_for_all_waits_as_a_whole_and_names_the_process() -> None:
    """Rows and explanations of all its processes have the reason."""
    cluster = cluster_of("ab").with_processes(process("other", memory=600))
    cluster.submit(*gang(300, 300, 500))
    assert phases(cluster) == ["queued"] * 3
    reason = cluster.explain("sensing-1")["reason"]
    assert reason.startswith("no room for all 3 of the gang sensing at once: sensing-")
    assert reason.endswith("fits on no host beside the others now")
    for name in ("sensing-0", "sensing-1", "sensing-2"):
        assert listing.process_row(cluster.state, cluster[name], cluster.now).reason == reason
    assert cluster.recorded("waits") == [f"sensing-0 waits: {reason}"]
    cluster.cancel("other")
    cluster.wait(1.0)
    assert phases(cluster) == ["running"] * 3


def test_a_gang_waits_for_the_one_process_that_fits_nowhere() -> None:
    """The reason does not blame the others."""
    cluster = cluster_of("ab").with_processes(
        process("one", memory=500), process("two", memory=500)
    )
    cluster.submit(*gang(100, 400))
    why = "no room for all 2 of the gang sensing at once: sensing-1 fits on no host now"
    assert cluster.explain("sensing-0")["reason"] == why


def test_a_waiting_gang_blocks_those_behind_it_unless_backfill_is_on() -> None:
    """The gang counts as one element at the place of its first process."""
    for backfill, after in ((False, "queued"), (True, "running")):
        cluster = cluster_of("ab", backfill=backfill).with_processes(process("other", memory=600))
        cluster.submit(*gang(300, 400, 400), process("small", memory=50))
        assert phases(cluster) == ["queued"] * 3
        assert cluster.phase("small") == after


def test_a_gang_is_placed_at_the_place_of_its_first_process() -> None:
    """Its other processes pass those that were submitted between them."""
    cluster = cluster_of("a")
    cluster.set_host("a", "cordon")
    first, second = gang(300, 300)
    cluster.submit(first, process("between", memory=300), second)
    cluster.set_host("a", "uncordon")
    cluster.wait(0.5)
    assert phases(cluster) == ["running"] * 2
    assert cluster.phase("between") == "queued"


def test_the_search_gives_a_small_host_to_the_small_process() -> None:
    """The best host of the first process is the only one of the second."""
    cluster = Cluster(machine("a"), machine("b", used=0.5))
    cluster.submit(*gang(250, 700))
    assert (cluster.where("sensing-0"), cluster.where("sensing-1")) == (["b"], ["a"])


def test_processes_get_devices_together() -> None:
    """The only camera goes to the gang, or to none of it."""
    cameras = (Device("camera", "0"), Device("camera", "1"))
    cluster = Cluster(machine("a", devices=cameras))
    cluster.submit(process("other", devices=(DeviceNeed("camera"),)))
    cluster.submit(*gang(10, 10, devices=(DeviceNeed("camera"),)))
    assert phases(cluster) == ["queued"] * 2
    cluster.cancel("other")
    cluster.wait(1.0)
    assert phases(cluster) == ["running"] * 2


def test_neighbours_inside_a_gang_do_not_wait_for_each_other() -> None:
    """`near` puts both on one host, and `spread` keeps the others apart."""
    camera, viewer, planner = gang(100, 100, 600)
    near = (NeighbourRule("near", (camera.name,)),)
    apart = (NeighbourRule("apart", (camera.name,)),)
    cluster = cluster_of("ab")
    viewer = replace(viewer, neighbours=near)
    planner = replace(planner, neighbours=apart)
    cluster.submit(viewer, planner, camera)
    where = [cluster.where(one.name) for one in (camera, viewer, planner)]
    assert where[0] == where[1] != where[2] != []


def test_a_gang_waits_for_a_neighbour_of_one_process() -> None:
    """The gang blocks no other process, and its reasons say so."""
    first, second = gang(100, 100)
    first = replace(first, neighbours=(NeighbourRule("near", ("map",)),))
    cluster = cluster_of("ab").with_processes(first, second, process("other"))
    assert (phases(cluster), cluster.phase("other")) == (["queued"] * 2, "running")
    why = cluster.explain("sensing-1")["reason"]
    assert why.startswith("sensing-0 of its gang sensing waits: map, near which")
    cluster.submit(process("map"))
    assert phases(cluster) == ["running"] * 2


# --- never ------------------------------------------------------------------------------------


def test_a_gang_of_which_one_process_fits_nowhere_is_set_aside_as_a_whole() -> None:
    """All return to the queue when hosts may take all."""
    first, second = gang(100, 100)
    second = replace(second, required_labels={"arm": "yes"})
    cluster = cluster_of("ab").with_processes(first, second, process("other"))
    assert (phases(cluster), cluster.phase("other")) == (["set_aside"] * 2, "running")
    assert cluster["sensing-0"].reason.startswith(
        "no hosts may take all 2 of the gang sensing: sensing-1: "
    )
    explained = cluster.explain("sensing-0")
    assert explained["decision"]["kind"] == "fits"  # a host could take this one alone
    assert explained["advice"].endswith(
        "run `rosrm cancel sensing-0 sensing-1` and submit all of the gang sensing again"
    )
    cluster.add(machine("c", labels={"arm": "yes"}))
    cluster.wait(1.0)
    assert phases(cluster) == ["running"] * 2


@pytest.mark.parametrize(
    ("specs", "why"),
    [
        (gang(600, 600, 600), "even if nothing else runs"),
        (gang(10, 10, 10, neighbours=(NeighbourRule("apart", group="g"),)), "beside the others"),
        (gang(10, 10, 10, devices=(DeviceNeed("camera"),)), "beside the others"),
    ],
)
def test_a_gang_that_fits_only_one_by_one_is_set_aside(specs: list[ProcessSpec], why: str) -> None:
    """Each process has a host, but two hosts cannot take all three at once."""
    cameras = (Device("camera", "0"),)
    cluster = Cluster(machine("a", devices=cameras), machine("b", devices=cameras))
    cluster.submit(*specs)
    cluster.wait(1.0)
    assert phases(cluster) == ["set_aside"] * 3
    assert why in cluster["sensing-0"].reason
    cluster.add(machine("c", devices=cameras))
    cluster.wait(2.0)
    assert phases(cluster) == ["running"] * 3


# --- names ------------------------------------------------------------------------------------


def test_a_second_gang_of_the_same_name_is_refused_until_the_first_has_started() -> None:
    """The names of other users are their own."""
    cluster = cluster_of("a").with_processes(process("other", memory=500), *gang(300, 300))
    again = [process("late", together="sensing")]
    reply = cluster.submit(*again)
    assert (reply.accepted, reply.code) == (False, "name_taken")
    assert reply.message.startswith(
        "a gang sensing waits already, and sensing-0 and sensing-1 of it have not started"
    )
    bob = Requester("user:bob")
    assert cluster.ask(happened.SubmissionReceived, gang(1, name="b"), bob).accepted
    cluster.cancel("other")
    cluster.wait(1.0)
    assert cluster.submit(*again).accepted
    cluster.wait(1.0)
    assert phases(cluster) == ["running"] * 3


def test_a_gang_has_at_most_64_processes() -> None:
    """The search for hosts is quick, so its size is bounded."""
    reply = cluster_of("a").submit(*gang(*[1] * 65))
    assert reply.message == (
        "the gang sensing has 65 processes; at most 64 start together. Nothing was queued"
    )


def test_a_cancelled_process_leaves_its_gang() -> None:
    """The others are placed without it."""
    cluster = cluster_of("a").with_processes(process("other", memory=300), *gang(300, 300))
    assert phases(cluster) == ["queued"] * 2
    cluster.cancel("sensing-1")
    cluster.wait(0.5)
    assert phases(cluster) == ["running", "cancelled"]


# --- after the assignment ---------------------------------------------------------------------


def test_a_refusal_before_the_start_returns_all_that_have_not_started() -> None:
    """They are placed again in one step, on hosts that can start them."""
    cluster = cluster_of("ab")
    cluster.machines["a"].refuses["sensing-0"] = "no such program"
    steps = steps_with_assignments(cluster)
    cluster.submit(*gang(300, 300, 300))
    cluster.wait(2.0)
    assert phases(cluster) == ["running"] * 3
    assert cluster.where("sensing-0") == ["b"]
    assert steps[0] == {"sensing-0", "sensing-1", "sensing-2"}


def test_assigned_processes_are_recalled_when_one_returns() -> None:
    """They have not started, and are placed again together with the refused one."""
    cluster = cluster_of("ab", delivery_timeout=30.0, lease=60.0, suspect=50.0)
    cluster.cut("a", "b")
    steps = steps_with_assignments(cluster)
    cluster.submit(*gang(700, 700))
    of_a = cluster.state.hosts.by_name["a"].instances
    ((refused, _),) = of_a.values()
    other = {"sensing-0": "sensing-1", "sensing-1": "sensing-0"}[refused]
    cluster.machines["a"].refuses[refused] = "no such program"
    cluster.reconnect("a", seconds=1.0)
    why = f"{refused} of its gang sensing has returned to the queue"
    assert cluster.recorded("stopping") == [f"{other} is stopped before its start: {why}"]
    assert cluster.phase(other) == "stopping"
    waits = cluster.explain(refused)["reason"]
    assert waits == f"{other} of its gang sensing is stopping"
    cluster.add(machine("c"))
    cluster.reconnect("b", seconds=5.0)
    assert phases(cluster) == ["running"] * 2
    assert len(steps) == 2
    assert steps[1] == {"sensing-0", "sensing-1"}


def test_a_process_that_has_started_is_not_touched_by_a_refusal() -> None:
    """The refused process is then placed alone."""
    cluster = cluster_of("ab")
    (first, second) = gang(700, 700)
    cluster.machines["b"].connected = False  # its messages are late
    cluster.submit(first, second)
    begun = next(name for name in ("sensing-0", "sensing-1") if cluster.where(name) == ["a"])
    late = {"sensing-0": "sensing-1", "sensing-1": "sensing-0"}[begun]
    cluster.machines["b"].refuses[late] = "no such program"
    cluster.reconnect("b", seconds=1.0)
    assert cluster.phase(begun) == "running"
    assert cluster[begun].restarts == 0
    assert cluster.phase(late) in ("queued", "set_aside", "failed")
    cluster.add(machine("c"))
    cluster.restart(late)
    cluster.wait(1.0)
    assert cluster.where(late) == ["c"]


def test_assignments_that_no_host_accepts_return_together() -> None:
    """The host was cut off between the decision and the start."""
    cluster = cluster_of("ab", delivery_timeout=1.0, lease=30.0, suspect=20.0)
    loss = HostLossPolicy("elsewhere")
    cluster.cut("a", "b")
    steps = steps_with_assignments(cluster)
    cluster.submit(*gang(300, 300, host_loss=loss))
    assert phases(cluster) == ["assigned"] * 2
    cluster.wait(0.5)
    assert cluster.submit(process("late", together="sensing")).code == "name_taken"
    cluster.reconnect("a", "b", seconds=5.0)
    assert phases(cluster) == ["running"] * 2
    assert all(one == {"sensing-0", "sensing-1"} for one in steps)


def test_a_running_process_of_a_gang_returns_to_the_queue_alone() -> None:
    """Its gang has started; restarts and moves are as of any process."""
    cluster = cluster_of("ab")
    cluster.submit(
        *(movable(one.name, needs=one.needs, together="sensing") for one in gang(700, 700))
    )
    gone = cluster.where("sensing-0")[0]
    cluster.add(machine("c"))
    cluster.leave(gone)
    cluster.wait(2.0)
    assert cluster.where("sensing-0") == ["c"]
    assert len(cluster.recorded("assigned")) == 3


def test_a_gang_stays_one_after_a_restart_of_the_master() -> None:
    """Queued or set aside."""
    cluster = Cluster(machine("a", used=0.6), machine("b"))
    cluster.submit(*gang(900, 10, name="large"), *gang(300, 500, 300))
    cluster.restart_master()
    cluster.wait(1.0)
    assert (phases(cluster), phases(cluster, "large")) == (["queued"] * 3, ["set_aside"] * 2)
    steps = steps_with_assignments(cluster)
    cluster.machines["a"].busy["memory"] = 0.0
    cluster.wait(1.0)
    assert steps == [{"sensing-0", "sensing-1", "sensing-2"}]


def test_an_assigned_process_stays_in_its_gang_over_a_restart_of_the_master() -> None:
    """Its host registers again; if that host starts nothing, both are placed together again."""
    cluster = cluster_of("ab", delivery_timeout=1.0, lease=30.0, suspect=20.0)
    cluster.cut("a", "b")
    cluster.submit(*gang(700, 700, host_loss=HostLossPolicy("elsewhere")))
    assert phases(cluster) == ["assigned"] * 2
    cluster.restart_master()
    assert [cluster[name].awaits_gang for name in ("sensing-0", "sensing-1")] == [True] * 2
    steps = steps_with_assignments(cluster)
    for name in "ab":
        cluster.rejoin(name)
    cluster.wait(5.0)
    assert phases(cluster) == ["running"] * 2
    assert steps in ([], [{"sensing-0", "sensing-1"}])


def test_a_waiting_process_can_get_another_gang() -> None:
    """A change in place moves a process from its former gang to the other one, and it waits."""
    cluster = cluster_of("a")
    other = [process(f"o{i}", memory=300 * (1 + i), together="other") for i in range(3)]
    alone = process("alone", memory=300)
    cluster.cut("a")  # nothing is placed
    cluster.state.hosts.by_name["a"].cordoned = True
    parts = [*gang(300, 300), *other]
    cluster.apply("nav", *parts, alone)
    changed = [replace(one, together="other") for one in (parts[0], alone)]
    cluster.apply("nav", changed[0], parts[1], *other, changed[1])
    members = {key[1]: list(names) for key, names in cluster.state.gangs.members.items() if key}
    assert sorted(members) == ["other", "sensing"]
    assert members["sensing"] == ["sensing-1"]
    assert sorted(members["other"]) == ["alone", "o0", "o1", "o2", "sensing-0"]


def test_ended_processes_that_are_restarted_together_are_a_gang_again() -> None:
    """Restarted alone, a process is placed alone."""
    cluster = cluster_of("ab")
    cluster.submit(*(job(one.name, needs=one.needs, together="sensing") for one in gang(500, 500)))
    for name in ("sensing-0", "sensing-1"):
        cluster.finish(name, on=cluster.where(name)[0])
    cluster.submit(process("other", memory=500))
    cluster.restart("sensing-0", "sensing-1")
    assert phases(cluster) == ["queued"] * 2
    cluster.cancel("sensing-1")
    cluster.wait(0.5)
    assert cluster.phase("sensing-0") == "running"


def test_room_is_made_for_each_process_of_a_gang() -> None:
    """Processes of lower priorities leave for the one that fits nowhere."""
    cluster = cluster_of("ab", preemption="requeue").with_processes(
        process("low", memory=600), process("lower", memory=600, priority=-1)
    )
    cluster.submit(*gang(500, 500, priority=5))
    cluster.wait(10.0)
    assert phases(cluster) == ["running"] * 2
    assert (cluster.phase("low"), cluster.phase("lower")) == ("queued", "queued")


def preempted(cluster: Cluster, name: str) -> int:
    """Return how often a process has made room."""
    kind = "preempted"
    return sum(one.kind == kind and one.process == name for one in cluster.records)


@pytest.mark.parametrize("preemption", ["requeue", "move"])
def test_no_process_makes_room_for_a_gang_that_cannot_be_placed_as_a_whole(
    preemption: str,
) -> None:
    """The other process of the gang fits on no host, whichever process leaves."""
    cluster = cluster_of("abc", preemption=preemption).with_processes(
        process("vital", memory=700, priority=9), process("too", memory=700, priority=9),
        movable("low", memory=300),
    )  # fmt: skip
    cluster.submit(*gang(600, 600, priority=5))
    cluster.wait(600.0, tick=0.5)
    assert (cluster.phase("low"), preempted(cluster, "low")) == ("running", 0)
    assert cluster.phase("sensing-0") == "queued"


def test_no_process_makes_room_for_a_gang_whose_other_room_is_protected() -> None:
    """Room must be made on two hosts, and on one of them it cannot be."""
    cluster = cluster_of("ab", preemption="requeue").with_processes(
        process("low", memory=600), process("kept", memory=600, protect=True)
    )
    cluster.submit(*gang(500, 500, priority=5))
    cluster.wait(300.0, tick=0.5)
    assert (cluster.phase("low"), preempted(cluster, "low")) == ("running", 0)


def test_a_trial_of_room_for_a_gang_changes_nothing() -> None:
    """The room, the devices and the queue are as before."""
    cluster = cluster_of("abc", preemption="requeue", cooldown=1.0).with_processes(
        process("vital", memory=700, priority=9), process("too", memory=700, priority=9),
        process("low", memory=300),
    )  # fmt: skip
    cluster.submit(*gang(600, 600, priority=5))
    cluster.wait(2.0)
    before = picture(cluster.state)
    cluster.now += 10.0
    preempt(cluster.state, cluster.now)
    assert picture(cluster.state) == before


# --- properties -------------------------------------------------------------------------------


def picture(state: MasterState) -> Any:
    """Return all that placement reads and changes, without caches and counters of changes."""
    table = state.hosts
    return (
        table.cells.tobytes(), table.processes.tolist(), [one.held for one in table.devices],
        list(state.queue), sorted(state.instances), sorted(state.set_aside),
        [
            (one.name, one.owner, sorted(one.instances), one.phase)
            for one in state.processes.values()
        ],
        [dict(host.instances) for host in table.hosts], state.next_instance,
        dict(state.neighbours.declared), dict(state.hosts.links.crossings), list(state._out),
    )  # fmt: skip


needs = st.lists(st.sampled_from([90.1, 200.3, 333.3, 500.7, 700.9]), min_size=2, max_size=4)
used = st.lists(st.sampled_from([0.0, 0.1, 0.33, 0.6]), min_size=1, max_size=3)


@given(memory=needs, used=used, spread=st.booleans(), cameras=st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_search_leaves_no_trace(
    memory: list[float], used: list[float], spread: bool, cameras: bool
) -> None:
    """Found or not, all trials are undone to the last bit."""
    unit = (Device("camera", "0"),)
    hosts = [machine(f"h{i}", load, devices=unit) for i, load in enumerate(used)]
    cluster = Cluster(*hosts).with_processes(process("other", memory=77.7))
    for one in hosts:
        cluster.set_host(one.name, "cordon")
    cluster.submit(
        *gang(
            *memory, neighbours=(NeighbourRule("apart", group="g"),) if spread else (),
            devices=(DeviceNeed("camera"),) if cameras else (), talks_to={"other": 1e6},
        )
    )  # fmt: skip
    state = cluster.state
    for name in list(state.set_aside):
        state.set_aside.discard(name)
        state.enqueue(state.processes[name], cluster.now)
    state.take()
    for host in state.hosts.hosts:
        state.hosts.set_closed(host, cordoned=False, draining=False)
    members = members_of(state, state.processes["sensing-0"])
    find_places(state, members)  # fills the caches
    before = picture(state)
    find_places(state, members)
    assert picture(state) == before


def fits(memory: Sequence[float], room: Sequence[float]) -> bool:
    """Return True if a gang fits on empty hosts, by trying all ways."""
    return any(
        all(
            sum(need for need, at in zip(memory, places, strict=True) if at == host) <= most
            for host, most in enumerate(room)
        )
        for places in product(range(len(room)), repeat=len(memory))
    )


sizes = st.lists(st.sampled_from([150.0, 400.0, 700.0, 1000.0]), min_size=1, max_size=3)


@given(first=needs, second=needs, sizes=sizes, backfill=st.booleans())
@settings(max_examples=25, deadline=None)
def test_two_gangs_that_each_fit_alone_both_run_in_the_end(
    first: list[float], second: list[float], sizes: list[float], backfill: bool
) -> None:
    """Neither holds a part of what the other one needs; a gang that never fits is set aside."""
    hosts = [machine(f"h{i}", memory=size) for i, size in enumerate(sizes)]
    room = [0.8 * size + 1e-3 for size in sizes]
    cluster = Cluster(*hosts, backfill=backfill, settle=0.5)
    specs = [
        job(one.name, needs=one.needs, together=one.together)
        for one in (*gang(*first, name="one"), *gang(*second, name="two"))
    ]
    steps = steps_with_assignments(cluster)
    cluster.submit(*specs)
    for _ in range(3):
        for name in _running(cluster):
            cluster.finish(name, on=cluster.where(name)[0])
        cluster.wait(2.0)
    for name, memory in (("one", first), ("two", second)):
        end = "finished" if fits(memory, room) else "set_aside"
        assert phases(cluster, name) == [end] * len(memory)
    for step in steps:
        for name, memory in (("one", first), ("two", second)):
            assert len([one for one in step if one.startswith(name)]) in (0, len(memory))


def _running(cluster: Cluster) -> Iterator[str]:
    return (one.name for one in list(cluster.state.processes.values()) if one.phase == "running")


def test_a_search_gives_up_after_a_bounded_number_of_trials() -> None:
    """Many equal processes that nearly fit would have too many ways."""
    cluster = Cluster(*(machine(f"h{i}") for i in range(8)))
    for one in range(8):
        cluster.set_host(f"h{one}", "cordon")
    cluster.submit(*(process(f"p{i}", memory=150 + 3 * i, together="g") for i in range(40)))
    for one in range(8):
        cluster.set_host(f"h{one}", "uncordon")
    cluster.settle()
    found = find_places(cluster.state, members_of(cluster.state, cluster["p0"]))
    assert isinstance(found, Blocked)


def test_a_search_for_places_keeps_what_its_processes_wait_for() -> None:
    """Otherwise a process of the gang started without waiting for the one that it starts after."""
    cluster = Cluster("a")
    cluster.submit(process("missing", required_labels={"no": "where"}))
    after = StartOrder({"missing": "ready"})
    cluster.submit(process("p", together="g", start_order=after), process("q", together="g"))
    cluster.wait(1.0)
    find_places(cluster.state, [cluster["p"], cluster["q"]])
    assert cluster.state.queue.awaiting == {"p"}
