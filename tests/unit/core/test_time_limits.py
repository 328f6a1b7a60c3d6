"""Time limits of jobs: a job that runs for too long is stopped, and has failed."""

from __future__ import annotations

import pytest

from rosrm.model.values import HostLossPolicy, RestartPolicy
from tests.unit.core.cluster import Cluster, job, movable


def lose_and_return(cluster: Cluster) -> None:
    cluster.cut("a", seconds=4.0)
    cluster.reconnect("a", seconds=1.0)


def test_a_job_that_runs_longer_than_its_time_limit_has_failed() -> None:
    """The slave stops it; its end is recorded with the limit."""
    cluster = Cluster("a").with_processes(job("p", time_limit=5.0))
    cluster.wait(4.5)
    assert cluster.phase("p") == "running"
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])
    assert cluster["p"].reason == "it ran longer than its time limit of 5 s"
    assert cluster.recorded("overdue") == ["p is stopped: its time limit of 5 s has passed"]


def test_a_job_that_ends_in_time_is_finished() -> None:
    """The limit then has no effect."""
    cluster = Cluster("a").with_processes(job("p", time_limit=5.0))
    cluster.finish("p")
    cluster.wait(6.0)
    assert cluster.phase("p") == "finished"


def test_restarts_count_for_the_time_limit() -> None:
    """Otherwise a job that fails again and again would have no limit."""
    cluster = Cluster("a")
    cluster.submit(job("p", time_limit=5.0, restart=RestartPolicy("on-failure")))
    cluster.wait(3.0)
    cluster.finish("p", code=1)
    cluster.wait(2.5)
    assert cluster.phase("p") == "failed"


def test_the_wait_in_the_queue_does_not_count_for_the_time_limit() -> None:
    """The limit begins with the start; a return to the queue begins it again."""
    cluster = Cluster("a")
    cluster.set_host("a", "cordon")
    cluster.submit(job("p", time_limit=5.0))
    cluster.wait(6.0)
    cluster.set_host("a", "uncordon")
    cluster.wait(4.0)
    assert cluster.phase("p") == "running"
    cluster.leave("a")
    cluster.add("b")
    cluster.wait(4.0)
    assert cluster.where("p") == ["b"]
    cluster.wait(2.0)
    assert cluster.phase("p") == "failed"


def test_a_move_does_not_begin_the_time_limit_again() -> None:
    """The job runs from its first start to its end, wherever it runs."""
    cluster = Cluster("a")
    cluster.submit(movable("p", kind=job("p").kind, time_limit=5.0))
    cluster.wait(3.0)
    cluster.add("b")
    assert cluster.migrate("p").accepted
    assert cluster.where("p") == ["b"]
    cluster.wait(2.5)
    assert cluster.phase("p") == "failed"


@pytest.mark.parametrize("restarted", [False, True])
def test_a_readopted_job_has_the_rest_of_its_time_limit(restarted: bool) -> None:
    """The job ran on while its host was lost, also if the master starts again in between."""
    elsewhere = HostLossPolicy("elsewhere")
    cluster = Cluster("a", lease=2.0)
    cluster.submit(job("p", time_limit=20.0, host_loss=elsewhere))
    cluster.add("b")
    cluster.set_host("b", "cordon")
    cluster.wait(5.0)
    cluster.cut("a", seconds=10.0)
    assert cluster.phase("p") == "queued"
    if restarted:
        cluster.restart_master()
        cluster.rejoin("a", 0.0)
    cluster.reconnect("a", seconds=2.0)
    assert cluster.phase("p") == "running"
    cluster.wait(5.0)
    assert cluster["p"].reason == "it ran longer than its time limit of 20 s"


def test_the_time_limit_survives_a_restart_of_the_master() -> None:
    """The time before the restart, and while no master runs, counts."""
    cluster = Cluster("a").with_processes(job("p", time_limit=5.0))
    cluster.wait(3.0)
    cluster.restart_master()
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    cluster.wait(1.5)
    assert cluster.phase("p") == "failed"


def test_an_overdue_job_fails_although_the_master_restarts_before_it_has_ended() -> None:
    """The new master knows why the job is being stopped."""
    cluster = Cluster("a").with_processes(job("p", time_limit=5.0))
    cluster.machines["a"].stubborn.add("p")
    cluster.wait(5.5)
    assert (cluster.phase("p"), cluster.where("p")) == ("stopping", ["a"])
    cluster.restart_master()
    cluster.let_go("p")
    assert (cluster.phase("p"), cluster["p"].reason[:24]) == ("failed", "it ran longer than its t")


def test_a_job_that_is_cancelled_while_it_is_overdue_is_cancelled() -> None:
    """The user's request is the later one."""
    cluster = Cluster("a").with_processes(job("p", time_limit=5.0))
    cluster.machines["a"].stubborn.add("p")
    cluster.wait(5.5)
    cluster.cancel("p")
    cluster.let_go("p")
    assert cluster.phase("p") == "cancelled"


YEARS = 56 * 365.25 * 86400.0


@pytest.mark.parametrize("seconds", [YEARS, -YEARS])
@pytest.mark.parametrize("fault", [Cluster.restart_master, lose_and_return])
def test_a_clock_that_is_set_changes_no_time_limit(fault, seconds) -> None:
    """The host reports for how long the job has run, so the unix time does not matter."""
    cluster = Cluster("a", lease=1.0, suspect=0.5)
    cluster.submit(job("p", time_limit=20.0, host_loss=HostLossPolicy("elsewhere", 0.0)))
    cluster.wait(2.0)
    cluster.clock_set_by = seconds
    fault(cluster)
    started = 100.0
    cluster.wait(started + 19.5 - cluster.now)
    assert cluster.phase("p") == "running"
    cluster.wait(1.0)
    assert cluster.phase("p") == "failed"


def test_a_moved_job_keeps_its_time_when_the_master_restarts() -> None:
    """Its new host knows only the time since the move; the journal has the time before."""
    cluster = Cluster("a")
    cluster.submit(movable("p", kind=job("p").kind, time_limit=10.0))
    cluster.wait(4.0)
    cluster.add("b")
    assert cluster.migrate("p", "b").accepted
    cluster.wait(2.0)
    assert cluster.where("p") == ["b"]
    cluster.clock_set_by = YEARS
    cluster.restart_master()
    cluster.wait(3.5)
    assert cluster.phase("p") == "running"
    cluster.wait(1.0)
    assert cluster.phase("p") == "failed"


def test_a_restarted_job_reports_its_time_since_its_first_start() -> None:
    """A restart by its policy begins no new time limit, also for a master that restarts."""
    cluster = Cluster("a")
    cluster.submit(job("p", time_limit=10.0, restart=RestartPolicy("on-failure")))
    cluster.wait(6.0)
    cluster.finish("p", code=1)
    cluster.wait(1.0)
    cluster.restart_master()
    cluster.wait(3.5)
    assert cluster.phase("p") == "failed"
