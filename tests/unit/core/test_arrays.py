"""Arrays: jobs of one entry, with a bound on the jobs at a time."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.core.master.invariants import check
from rosrm.model.arrays import ArrayMembership
from rosrm.model.requester import Requester
from rosrm.model.values import NeighbourRule, ProcessSpec, ReschedulePolicy, StartOrder
from tests.unit.core.cluster import Cluster, Machine, job, node, process
from tests.unit.core.test_gangs import machine

ONE_RUNS = "1 of the array r runs already"


def array(
    count: int = 4, parallel: int = 2, name: str = "r", **fields: object
) -> list[ProcessSpec]:
    """Return the jobs of an array: r-1, r-2, ..."""
    return [
        job(f"{name}-{index}", array=ArrayMembership(name, index, parallel), **fields)
        for index in range(1, count + 1)
    ]


def running(cluster: Cluster) -> list[str]:
    return sorted(name for name in cluster.state.processes if cluster.where(name))


def reason(cluster: Cluster, name: str) -> str:
    return listing.process_row(cluster.state, cluster[name], cluster.now).reason


def test_at_most_parallel_jobs_of_an_array_run_at_a_time() -> None:
    """The next one follows when one has ended, in order."""
    cluster = Cluster("a", "b").with_processes(*array())
    assert running(cluster) == ["r-1", "r-2"]
    assert reason(cluster, "r-3") == "2 of the array r run already"
    assert reason(cluster, "r-3") in cluster.explain("r-3")["reason"]
    cluster.finish("r-1", on=cluster.where("r-1")[0], code=1)
    assert running(cluster) == ["r-2", "r-3"]
    cluster.cancel("r-2")
    assert running(cluster) == ["r-3", "r-4"]


def test_jobs_beyond_the_bound_do_not_block_those_behind_them() -> None:
    """Other processes and other arrays are placed at once."""
    cluster = Cluster("a").with_processes(*array(parallel=1), process("p"))
    cluster.submit(*array(2, 1, name="s"))
    assert running(cluster) == ["p", "r-1", "s-1"]


def test_without_a_bound_all_jobs_run() -> None:
    """The array is then a name only."""
    cluster = Cluster("a").with_processes(*array(parallel=0))
    assert len(running(cluster)) == 4


def after(name: str) -> StartOrder:
    return StartOrder({name: "ready"})


WAITS: dict[str, dict[str, Any]] = {
    "a process": {"start_order": after("slow")},
    "a neighbour": {"neighbours": (NeighbourRule("near", ("late",)),)},
    "its gang": {"together": "g"},
    "the delay after a failure": {"reschedule": ReschedulePolicy(1, 100.0)},
}


@pytest.mark.parametrize("fields", WAITS.values(), ids=WAITS)
def test_a_job_that_waits_for_something_else_holds_no_place(fields: dict[str, Any]) -> None:
    """The next job has the place; the first one has it once it is free and the wait is over."""
    cluster = Cluster("a", "b").with_processes(
        node("slow"), process("late", start_order=after("slow")),
        *array(1, 1, **fields), process("mate", together="g", start_order=after("slow")),
    )  # fmt: skip
    if cluster.where("r-1"):
        cluster.finish("r-1", on=cluster.where("r-1")[0], code=1)
    cluster.submit(*array(2, 1)[1:])
    assert (cluster.where("r-1"), cluster.phase("r-2")) == ([], "running")
    cluster.discover("slow", cluster.where("slow")[0])
    cluster.wait(101.0)
    assert (cluster.phase("r-1"), reason(cluster, "r-1")) == ("queued", ONE_RUNS)
    cluster.finish("r-2", on=cluster.where("r-2")[0])
    assert cluster.phase("r-1") == "running"


def test_a_job_that_waits_for_a_host_holds_no_place() -> None:
    """With backfill, the first job that fits has the place."""
    cluster = Cluster(machine("a"), backfill=True).with_processes(process("p", memory=500))
    cluster.submit(*array(1, 1, memory=500), *array(2, 1)[1:])
    assert running(cluster) == ["p", "r-2"]
    assert reason(cluster, "r-1") == ONE_RUNS
    cluster.cancel("p", "r-2")
    assert running(cluster) == ["r-1"]


@pytest.mark.parametrize("backfill", [False, True])
def test_a_gang_takes_all_of_its_places_at_once(backfill: bool) -> None:
    """Without backfill, those behind it in the array do not take what it waits for."""
    cluster = Cluster("a", backfill=backfill).with_processes(*array(1, 2))
    cluster.submit(*array(3, 2, together="g")[1:], *array(4, 2)[3:], process("p"))
    others = ["r-4"] if backfill else []
    assert running(cluster) == ["p", "r-1", *others]
    why = "and 2 of the gang g start at once"
    for name in ("r-2", "r-3"):
        assert reason(cluster, name).endswith(why)
        assert cluster.explain(name)["reason"].endswith(why)
    if not backfill:
        assert reason(cluster, "r-4") == "a gang before it waits for places of the array r"
    cluster.finish("r-1")
    assert running(cluster) == (["p", "r-4"] if backfill else ["p", "r-2", "r-3"])
    cluster.finish("r-4" if backfill else "r-2")
    assert running(cluster) == (["p", "r-2", "r-3"] if backfill else ["p", "r-3", "r-4"])


def test_a_gang_that_is_queued_in_part_waits_behind_a_gang_that_awaits_places() -> None:
    """Its other member is being stopped on a host that does not answer."""
    cluster = Cluster(Machine("a", labels={"on": "a"}), Machine("b", labels={"on": "b"}))

    def of(name: str, index: int, **more: Any) -> ProcessSpec:
        return job(name, array=ArrayMembership("A", index, 3), **more)

    cluster.with_processes(of("x", 1))
    cluster.machines["a"].refuses["refused"] = "no such file"
    cluster.machines["b"].connected = False
    cluster.submit(
        of("refused", 2, together="second", required_labels={"on": "a"}),
        job("stopped", together="second", required_labels={"on": "b"}),
    )
    cluster.submit(*(of(f"first{n}", 3 + n, together="first", priority=5) for n in range(3)))
    cluster.wait(1.0)
    assert (cluster.phase("refused"), cluster.phase("stopped")) == ("queued", "stopping")
    cluster.restart_master()
    cluster.wait(1.0)
    assert (cluster.phase("refused"), cluster.phase("stopped")) == ("queued", "unreachable")


def test_no_process_makes_room_for_a_job_without_a_place() -> None:
    """Room is made for the first of two jobs that want one place."""
    cluster = Cluster(machine("a"), preemption="requeue", backfill=True, hysteresis=0.5)
    cluster.submit(*(process(f"p{at}", memory=350) for at in (1, 2)))
    cluster.submit(*array(1, 1, priority=5), *array(3, 1, memory=350, priority=5)[1:])
    cluster.wait(5.0)
    assert running(cluster) == ["p1", "p2", "r-1"]
    cluster.finish("r-1")
    cluster.wait(5.0)
    assert len(cluster.recorded("preempted")) == 2  # one for each of both processes
    assert [name for name in running(cluster) if name.startswith("r")] == ["r-2"]


def test_a_waiting_job_can_be_cancelled_and_submitted_again() -> None:
    """The new one waits behind the others."""
    cluster = Cluster("a").with_processes(*array(4, 1))
    cluster.cancel("r-2")
    assert cluster.phase("r-2") == "cancelled"
    assert cluster.submit(array(4, 1)[1]).accepted
    cluster.finish("r-1")
    assert running(cluster) == ["r-3"]


def test_the_bound_survives_a_restart_of_the_master() -> None:
    """Also if a job that waits has an earlier order than one that runs."""
    cluster = Cluster("a", "b")
    cluster.submit(*array(4, 2, reschedule=ReschedulePolicy(1, 30.0)))
    (host,) = cluster.where("r-1")
    cluster.finish("r-1", on=host, code=1)
    before = running(cluster)
    cluster.restart_master()
    cluster.wait(2.0)
    assert running(cluster) == before
    check(cluster.state)


def test_a_job_that_is_set_aside_gives_up_its_place() -> None:
    """No host may take it, so the next one runs."""
    cluster = Cluster("a")
    first = array(1, 1, required_labels={"arm": "yes"})
    cluster.submit(*first, *array(3, 1)[1:])
    cluster.wait(0.5)
    assert cluster.phase("r-1") == "set_aside"
    assert running(cluster) == ["r-2"]
    cluster.add(Machine("b", labels={"arm": "yes"}))
    cluster.wait(1.0)
    assert running(cluster) == ["r-2"]
    cluster.finish("r-2")
    assert running(cluster) == ["r-1"]


def test_arrays_of_two_users_are_apart() -> None:
    """Another user's jobs take no place, although the array has the same name."""
    cluster = Cluster("a")
    ada, bob = (Requester(f"user:{name}") for name in ("ada", "bob"))
    cluster.ask(happened.SubmissionReceived, tuple(array(2, 1)[:1]), ada)
    cluster.ask(happened.SubmissionReceived, tuple(array(2, 1)[1:]), bob)
    assert running(cluster) == ["r-1", "r-2"]


@pytest.mark.parametrize("backfill", [True, False])
@given(data=st.data())
def test_the_bound_holds_whatever_happens(backfill: bool, data: st.DataObject) -> None:
    """Ends, failures, cancellations, restarts and lost hosts in any order."""
    parallel = data.draw(st.integers(1, 3))
    cluster = Cluster("a", "b", backfill=backfill, lease=2.0)
    cluster.submit(*array(6, parallel, reschedule=ReschedulePolicy(1)))
    for _ in range(data.draw(st.integers(1, 8))):
        name = f"r-{data.draw(st.integers(1, 6))}"
        change = data.draw(st.sampled_from(["end", "end", "fail", "cancel", "restart", "master"]))
        where = cluster.where(name)
        if change in ("end", "fail") and where:
            cluster.finish(name, on=where[0], code=int(change == "fail"))
        elif change == "cancel":
            cluster.cancel(name)
        elif change == "restart":
            cluster.restart(name)
        elif change == "master":
            cluster.restart_master()
        cluster.wait(0.3)
        assert len(running(cluster)) <= parallel
        check(cluster.state)
