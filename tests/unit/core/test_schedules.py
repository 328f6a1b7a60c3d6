"""Schedules: jobs that start again at an interval or at times of day."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest

from rosrm.core.master import listing
from rosrm.model.schedules import Schedule
from rosrm.model.values import HostLossPolicy, ReschedulePolicy, RestartPolicy
from tests.unit.core.cluster import Cluster, job
from tests.unit.core.test_applications import program

EVERY_10_S = Schedule(every=10.0)


def daily(cluster: Cluster, seconds: int) -> Schedule:
    """Return a daily schedule whose next time is in whole minutes after some seconds."""
    at = datetime.fromtimestamp(cluster.wall + seconds, timezone.utc)
    return Schedule(at=(f"{at:%H:%M} UTC",))


def reason(cluster: Cluster, name: str = "p") -> str:
    return listing.process_row(cluster.state, cluster[name], cluster.now).reason


def starts(cluster: Cluster, name: str = "p") -> int:
    """Return the number of starts of a job."""
    return cluster.assigned().count(name)


def test_a_job_starts_again_at_a_fixed_rate_from_its_first_start() -> None:
    """The time that a run takes does not shift the next one."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    assert cluster.phase("p") == "running"
    for run, (seconds, rest) in enumerate([(3.0, 6.5), (5.5, 3.5)], 1):
        cluster.wait(seconds)
        cluster.finish("p")
        assert (cluster.phase("p"), cluster.where("p")) == ("scheduled", [])
        cluster.wait(rest)
        assert (cluster.phase("p"), starts(cluster)) == ("scheduled", run)
        cluster.wait(1.0)
        assert (cluster.phase("p"), starts(cluster)) == ("running", run + 1)


def test_the_wait_for_a_host_precedes_the_first_start() -> None:
    """The interval begins when the job first runs."""
    cluster = Cluster().with_processes(job("p", schedule=EVERY_10_S))
    cluster.wait(15.0)
    cluster.add("a")
    cluster.finish("p")
    cluster.wait(9.0)
    assert cluster.phase("p") == "scheduled"
    cluster.wait(1.5)
    assert cluster.phase("p") == "running"
    assert cluster.recorded("run_skipped") == []


def test_a_job_waits_for_its_time_of_day() -> None:
    """The row and the explanation have the time of the next run."""
    cluster = Cluster("a")
    reply = cluster.submit(job("p", schedule=daily(cluster, 180)), job("q"))
    assert reply.message == "1 process queued; 1 process waits for the first run"
    assert (cluster.phase("p"), starts(cluster)) == ("scheduled", 0)
    at = cluster["p"].spec.schedule.at[0]
    assert reason(cluster).startswith(f"next run at {at} (in ")
    assert reason(cluster) in cluster.explain("p")["reason"]
    cluster.wait(180.5, tick=0.5)
    assert (cluster.phase("p"), starts(cluster)) == ("running", 1)
    cluster.finish("p")
    assert reason(cluster) == f"next run at {at} (in 23 h 59 min); its last run finished"


def test_a_run_is_skipped_while_the_former_one_has_not_ended() -> None:
    """The skipped run is recorded, and the rate stays."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    cluster.wait(11.0)
    (said,) = cluster.recorded("run_skipped")
    assert said.endswith("is skipped, because the former run has not ended (it is running)")
    cluster.wait(4.0)
    cluster.finish("p")
    cluster.wait(4.5)
    assert cluster.phase("p") == "scheduled"
    cluster.wait(1.0)
    assert (cluster.phase("p"), starts(cluster)) == ("running", 2)


def test_a_failed_run_is_not_the_end_of_the_schedule() -> None:
    """The row keeps exit code, host and reason; the next run has all attempts again."""
    cluster = Cluster("a", "b")
    fields = {"restart": RestartPolicy("never"), "reschedule": ReschedulePolicy(1)}
    cluster.submit(job("p", schedule=Schedule(every=20.0), **fields))
    for _ in range(2):
        for _ in range(2):
            (host,) = cluster.where("p")
            cluster.finish("p", on=host, code=2)
        row = listing.process_row(cluster.state, cluster["p"], cluster.now)
        assert (row.state, row.exit_code, row.host) == ("scheduled", 2, host)
        assert row.reason.endswith("; its last run failed: exit code 2")
        cluster.wait(20.5)
    assert len(cluster.recorded("failed")) == 2


def test_a_run_over_its_time_limit_fails_alone() -> None:
    """The job then waits for its next run."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S, time_limit=3.0))
    cluster.wait(4.0)
    assert cluster.phase("p") == "scheduled"
    assert "it ran longer than its time limit of 3 s" in reason(cluster)
    cluster.wait(6.5)
    assert cluster.phase("p") == "running"


def test_a_restart_runs_the_job_now() -> None:
    """The times of the other runs stay."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    cluster.finish("p")
    cluster.wait(2.0)
    due = cluster["p"].next_run
    assert cluster.restart("p").accepted
    assert (cluster.phase("p"), cluster["p"].next_run) == ("running", due)


def test_a_cancellation_ends_the_schedule() -> None:
    """Between two runs as well as during a run."""
    cluster = Cluster("a").with_processes(
        job("p", schedule=EVERY_10_S), job("q", schedule=EVERY_10_S)
    )
    cluster.finish("p")
    assert cluster.cancel("p", "q").accepted
    cluster.wait(21.0)
    assert (cluster.phase("p"), cluster.phase("q")) == ("cancelled", "cancelled")
    assert (starts(cluster, "p"), starts(cluster, "q")) == (1, 1)
    assert not cluster.state.scheduled


def test_missed_runs_follow_once_after_the_master_was_down() -> None:
    """The record says how late the run is; the rate stays."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    cluster.finish("p")
    due = cluster["p"].next_run
    cluster.now += 35.0
    cluster.restart_master()
    cluster.wait(1.5)
    assert (cluster.phase("p"), starts(cluster)) == ("running", 2)
    assert cluster.recorded("queued")[-1].endswith(" UTC, 25 s late")
    assert cluster["p"].next_run == due + 30.0


def test_a_restarted_master_keeps_the_time_of_the_next_run_and_the_result_of_the_last() -> None:
    """Nothing begins before its time."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    cluster.finish("p", code=3)
    before = reason(cluster)
    cluster.restart_master()
    row = listing.process_row(cluster.state, cluster["p"], cluster.now)
    assert (row.reason, row.exit_code, row.host) == (before, 3, "a")
    cluster.wait(9.0)
    assert starts(cluster) == 1
    cluster.wait(1.5)
    assert starts(cluster) == 2


def test_a_run_is_not_skipped_while_its_host_may_have_ended_the_former_one() -> None:
    """The run follows once the host reports."""
    cluster = Cluster("a", lease=2.0)
    cluster.submit(job("p", schedule=EVERY_10_S, host_loss=HostLossPolicy("wait")))
    cluster.cut("a", seconds=5.0)
    cluster.machines["a"].finish("p", cluster.now, code=0, run_time=1.0)
    cluster.wait(10.0)
    assert cluster.recorded("run_skipped") == []
    cluster.rejoin("a", 2.0)
    assert (cluster.phase("p"), starts(cluster)) == ("running", 2)


def test_a_clock_that_is_set_back_delays_no_run_by_more_than_an_interval() -> None:
    """The next run is computed again."""
    cluster = Cluster("a").with_processes(job("p", schedule=EVERY_10_S))
    cluster.finish("p")
    cluster["p"].next_run += 3600.0
    cluster.wait(10.5)
    assert cluster.phase("p") == "running"


def test_a_job_that_no_host_can_start_waits_for_its_next_run() -> None:
    """All hosts have refused it for this run only."""
    cluster = Cluster("a")
    cluster.machines["a"].refuses["p"] = "no such program"
    cluster.submit(job("p", schedule=EVERY_10_S))
    assert cluster.phase("p") == "scheduled"
    cluster.machines["a"].refuses.clear()
    cluster.wait(10.5)
    assert cluster.phase("p") == "running"


@pytest.mark.parametrize(
    ("schedule", "waits"),
    [(EVERY_10_S, 7.0), (Schedule(every=20.0), 17.0), (Schedule(every=4.0), 1.0)],
    ids=["the same interval", "a longer one", "a shorter one"],
)
def test_a_job_that_changes_between_two_runs_waits_for_the_next_one(
    schedule: Schedule, waits: float
) -> None:
    """The interval counts from its last start; the next run has the new spec."""
    cluster = Cluster("a")
    cluster.apply("app", job("p", schedule=EVERY_10_S))
    cluster.wait(3.0)
    cluster.finish("p")
    assert cluster.apply("app", job("p", command=("new",), schedule=schedule)).accepted
    cluster.wait(waits - 0.5)
    assert (cluster.phase("p"), starts(cluster)) == ("scheduled", 1)
    cluster.wait(1.0)
    assert (program(cluster, "p"), starts(cluster)) == (("new",), 2)


def test_a_job_that_loses_its_schedule_between_two_runs_runs_once() -> None:
    """The job is like any other from then on."""
    cluster = Cluster("a")
    cluster.apply("app", job("p", schedule=EVERY_10_S))
    cluster.finish("p")
    cluster.apply("app", job("p"))
    cluster.wait(1.0)
    assert starts(cluster) == 2
    cluster.finish("p")
    cluster.wait(15.0)
    assert (cluster.phase("p"), starts(cluster)) == ("finished", 2)


def test_a_job_that_loses_its_schedule_is_queued_like_a_new_one() -> None:
    """The job waits after all others, and may use a host on which its last run failed."""
    cluster = Cluster("a")
    fields = {"restart": RestartPolicy("never"), "reschedule": ReschedulePolicy(1)}
    cluster.apply("app", job("p", schedule=EVERY_10_S, **fields))
    cluster.submit(job("q"))
    cluster.finish("p", code=2)
    assert cluster["p"].failed_on
    cluster.apply("app", job("p", **fields))
    assert not cluster["p"].failed_on
    assert cluster["p"].order > cluster["q"].order
