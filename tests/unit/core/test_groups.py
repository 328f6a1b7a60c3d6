"""Groups: the end of one process cancels the others of its group."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.model.requester import Requester
from rosrm.model.values import (
    GroupEnd,
    GroupMembership,
    ProcessSpec,
    ReschedulePolicy,
    RestartPolicy,
)
from tests.unit.core.cluster import Cluster, job, movable, process


def in_demo(spec: ProcessSpec, ends: GroupEnd = "never") -> ProcessSpec:
    """Return a spec as a member of the group `demo`."""
    return replace(spec, group=GroupMembership("demo", ends))


def demo(ends: GroupEnd = "always", *hosts: str) -> Cluster:
    """Return a cluster in which `rviz`, whose end ends the group, and `slam` run."""
    cluster = Cluster(*(hosts or "a"))
    return cluster.with_processes(in_demo(process("rviz"), ends), in_demo(process("slam")))


def end(cluster: Cluster, name: str, code: int = 0) -> None:
    cluster.finish(name, on=cluster.where(name)[0], code=code)


def test_the_end_of_a_process_cancels_the_others_of_its_group() -> None:
    """Their records and their rows name the cause; a process of no group keeps running."""
    cluster = demo().with_processes(process("other"))
    end(cluster, "rviz")
    cluster.wait(1.0)
    assert [cluster.phase(name) for name in ("rviz", "slam", "other")] == [
        "finished", "cancelled", "running",
    ]  # fmt: skip
    cause = "rviz of the group demo finished"
    assert cluster.recorded("cancel_requested") == [f"slam is cancelled: {cause}"]
    assert listing.process_row(cluster.state, cluster["slam"], cluster.now).reason == cause


@pytest.mark.parametrize(("code", "after"), [(0, "running"), (3, "cancelled")])
def test_a_process_may_end_its_group_only_by_a_failure(code: int, after: str) -> None:
    """`fails_with` leaves the group running when the process finishes."""
    cluster = demo("on-failure")
    end(cluster, "rviz", code)
    cluster.wait(1.0)
    assert cluster.phase("slam") == after


def test_a_cancellation_does_not_end_the_group() -> None:
    """A user who cancels one process means that process."""
    cluster = demo()
    cluster.cancel("rviz")
    cluster.wait(1.0)
    assert (cluster.phase("rviz"), cluster.phase("slam")) == ("cancelled", "running")


def test_a_process_that_starts_again_has_not_ended() -> None:
    """Restarts and starts on other hosts come first."""
    cluster = Cluster("a", "b").with_processes(
        in_demo(process("rviz", reschedule=ReschedulePolicy(1)), "always"),
        in_demo(process("slam", restart=RestartPolicy("on-failure", delay=0.5)), "always"),
    )
    end(cluster, "slam", 3)
    end(cluster, "rviz", 3)
    cluster.wait(1.0)
    assert (cluster.phase("rviz"), cluster.phase("slam")) == ("running", "running")
    end(cluster, "rviz", 3)
    cluster.wait(1.0)
    assert (cluster.phase("rviz"), cluster.phase("slam")) == ("failed", "cancelled")


def test_queued_members_leave_the_queue() -> None:
    """They have never run."""
    cluster = demo().with_processes(in_demo(process("late", memory=1e6)))
    assert cluster.phase("late") in ("queued", "set_aside")
    end(cluster, "rviz", 1)
    assert cluster.phase("late") == "cancelled"


def test_a_time_limit_counts_as_a_failure() -> None:
    """The job was stopped by the master, and no client has cancelled it."""
    cluster = Cluster("a").with_processes(
        in_demo(job("record", time_limit=2.0), "on-failure"), in_demo(process("slam"))
    )
    cluster.wait(4.0)
    assert (cluster.phase("record"), cluster.phase("slam")) == ("failed", "cancelled")


def test_a_process_that_no_host_can_start_ends_the_group_as_a_failure() -> None:
    """The master itself finds that out when it places the process."""
    cluster = Cluster("a").with_processes(in_demo(process("slam")))
    cluster.machines["a"].refuses["rviz"] = "no such program"
    cluster.submit(in_demo(process("rviz"), "on-failure"))
    cluster.wait(1.0)
    assert (cluster.phase("rviz"), cluster.phase("slam")) == ("failed", "cancelled")


def test_a_member_that_moves_is_cancelled_after_its_move_is_undone() -> None:
    """As any cancellation during a migration."""
    cluster = Cluster("a", "b").with_processes(
        in_demo(movable("slam")), in_demo(process("rviz"), "always")
    )
    there = {"a": "b", "b": "a"}[cluster.where("slam")[0]]
    cluster.ask(happened.MigrationRequested, "slam", there, settle=False)
    end(cluster, "rviz")
    cluster.wait(5.0)
    assert (cluster.phase("slam"), cluster.where("slam")) == ("cancelled", [])


def test_the_group_ends_although_the_master_restarts_at_once() -> None:
    """The end and the cancellations are durable in one step."""
    cluster = demo("always", "a", "b")
    host = cluster.where("slam")[0]
    cluster.machines[host].connected = cluster.where("rviz")[0] == host
    machine = cluster.machines[cluster.where("rviz")[0]]
    machine.finish("rviz", cluster.now)
    cluster.settle()
    assert cluster["slam"].wanted == "cancel"
    cluster.restart_master()
    for machine in cluster.machines.values():
        machine.connected = True
        cluster.register(machine)
    cluster.wait(2.0)
    assert (cluster.phase("slam"), cluster.where("slam")) == ("cancelled", [])
    assert cluster["slam"].reason == "rviz of the group demo finished"


def test_a_group_is_that_of_one_user() -> None:
    """The same name of another user is another group, and a later file of the user joins it."""
    cluster = Cluster("a")
    ada, bob = Requester("user:ada"), Requester("user:bob")
    for name, by in (("rviz", ada), ("slam", bob), ("nav", ada)):
        spec = in_demo(process(name), "always" if name == "rviz" else "never")
        assert cluster.ask(happened.SubmissionReceived, (spec,), by).accepted
    end(cluster, "rviz")
    cluster.wait(1.0)
    assert (cluster.phase("slam"), cluster.phase("nav")) == ("running", "cancelled")


def test_a_process_that_a_client_restarts_has_no_cause_left() -> None:
    """The next cancellation may have another cause."""
    cluster = demo()
    end(cluster, "rviz")
    cluster.wait(1.0)
    cluster.restart("slam")
    cluster.wait(1.0)
    assert (cluster.phase("slam"), cluster["slam"].reason) == ("running", "")
    cluster.cancel("slam")
    cluster.wait(1.0)
    assert (cluster.phase("slam"), cluster["slam"].reason) == ("cancelled", "")


def test_finished_jobs_that_an_application_wants_take_no_place_of_the_others() -> None:
    """They stay; the end of a process is still listed, and still ends its group."""
    cluster = Cluster("a", keep_ended=3)
    cluster.apply("batch", *[job(f"j{number}") for number in range(3)])
    cluster.wait(1.0)
    for number in range(3):
        cluster.finish(f"j{number}")
    cluster.wait(3.0)
    group = GroupMembership("launch", "on-failure")
    cluster.submit(process("p", group=group), process("q", group=group))
    cluster.wait(1.0)
    cluster.finish("p", code=7)
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster["p"].exit_code) == ("failed", 7)
    assert cluster.phase("q") == "cancelled"
