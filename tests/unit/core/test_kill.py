"""An operator's kill of processes ends, whichever delays the processes and their specs cause."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.model.durations import LONGEST_STOP
from rosrm.model.orders import FenceInstance, StopInstance
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec, StartOrder, StopPolicy
from tests.unit.core.cluster import Cluster, Machine, movable, process

MALLORY = Requester("user:mallory")
ROOT = Requester("user:root", is_operator=True)


def kill(cluster: Cluster, *names: str) -> Reply:
    return cluster.ask(happened.CancelRequested, names, ROOT, True, settle=False)


@pytest.mark.parametrize(
    "stop",
    [
        StopPolicy(7_200_000.0), StopPolicy(terminate_grace=7_200_000.0), StopPolicy(300.0, 301.0),
        StopPolicy(float("nan")), StopPolicy(float("inf")), StopPolicy(-1.0, 5.0),
    ],
)  # fmt: skip
def test_a_process_that_would_stop_too_late_is_refused(stop: StopPolicy) -> None:
    """Submissions and applications with a stop of more than 10 minutes are refused."""
    cluster = Cluster("a")
    for reply in (
        cluster.submit(process("p", stop=stop)),
        cluster.apply("app", process("p", stop=stop)),
    ):
        assert not reply.accepted
        assert "600 s together" in reply.message
    assert cluster.submit(process("p", stop=StopPolicy(LONGEST_STOP, 0.0))).accepted


def stubborn(*specs: ProcessSpec) -> Cluster:
    """Return a cluster whose processes do not end by an ordered stop."""
    cluster = Cluster(Machine("a", stubborn={spec.name for spec in specs}), "b")
    cluster.set_host("b", "cordon")
    return cluster.with_processes(*specs)


def test_a_kill_ends_what_is_being_stopped() -> None:
    """The slave gets an order to kill, although it has the order to stop already."""
    cluster = stubborn(process("p"))
    cluster.cancel("p")
    cluster.wait(3.0)
    assert cluster.phase("p") == "stopping"
    assert kill(cluster, "p").accepted
    assert [one.instance.process for one in cluster.orders(FenceInstance)] == ["p"]
    cluster.machines["a"].let_go("p", cluster.now)
    cluster.settle()
    assert cluster.phase("p") == "cancelled"


def test_a_kill_is_repeated_as_a_kill() -> None:
    """The first order may be lost on its way."""
    cluster = stubborn(process("p"))
    cluster.cut("a")
    kill(cluster, "p")
    cluster.wait(5.0)
    assert len(cluster.orders(FenceInstance)) >= 2
    assert len(cluster.orders(StopInstance)) <= 1  # of the cancellation


def test_a_kill_is_a_kill_after_a_restart_of_the_master() -> None:
    """The next master does not wait for the graces of the stop either."""
    cluster = stubborn(process("p"))
    cluster.cut("a")
    kill(cluster, "p")
    cluster.restart_master()
    cluster.carried.clear()
    cluster.rejoin("a", seconds=3.0)
    assert cluster.orders(FenceInstance)
    assert not cluster.orders(StopInstance)


def test_a_kill_does_not_wait_for_dependants_after_a_restart_of_the_master() -> None:
    """The dependant is still being stopped when the process is killed."""
    after = process("after", start_order=StartOrder(after={"p": "ready"}))
    cluster = stubborn(process("p"), after)
    cluster.wait(1.0)
    cluster.cancel("after", "p")
    cluster.cut("a")
    kill(cluster, "p")
    cluster.restart_master()
    cluster.rejoin("a", seconds=3.0)
    assert "p" not in cluster.state.start_orders.last_to_stop
    assert cluster.where("p") == []


def test_a_process_that_is_restarted_after_a_kill_is_stopped_with_its_graces() -> None:
    """The kill was meant only for the earlier cancellation."""
    cluster = Cluster("a").with_processes(process("p"))
    kill(cluster, "p")
    cluster.settle()
    cluster.restart("p")
    cluster.wait(1.0)
    cluster.cancel("p")
    assert len(cluster.orders(StopInstance)) == 2  # the first one of the first cancellation


def test_a_kill_does_not_wait_for_dependants() -> None:
    """A cancelled process is killed while the one that starts after it is being stopped."""
    after = process("after", start_order=StartOrder(after={"p": "ready"}))
    cluster = stubborn(process("p"), after)
    cluster.wait(1.0)
    cluster.cancel("after", "p")
    assert "p" in cluster.state.start_orders.last_to_stop
    kill(cluster, "p")
    assert [one.instance.process for one in cluster.orders(FenceInstance)] == ["p"]


def test_a_kill_ends_all_instances_of_a_migration() -> None:
    """Source and destination are killed, and the process is cancelled."""
    cluster = Cluster("a", "b").with_processes(movable("p"))
    cluster.wait(1.0)
    for machine in cluster.machines.values():
        machine.stubborn.add("p")
    assert cluster.migrate("p").accepted
    kill(cluster, "p")
    killed = {one.instance.number for one in cluster.orders(FenceInstance)}
    assert killed == set(cluster["p"].instances)
    for name, machine in cluster.machines.items():
        if name in cluster.where("p"):
            machine.let_go("p", cluster.now)
    cluster.wait(3.0)
    assert cluster.phase("p") == "cancelled"


def test_a_kill_of_a_queued_or_ended_process_is_a_cancellation() -> None:
    """Such a process has no instance to kill, so it is only cancelled."""
    cluster = stubborn(process("p"), process("q", memory=10**9))
    cluster.cancel("p")
    assert kill(cluster, "q", "p").accepted
    assert cluster.phase("q") == "cancelled"
