"""Reschedule: a process that has failed on one host starts on another one."""

from __future__ import annotations

import pytest

from rosrm.core.master import events as happened
from rosrm.core.master import listing
from rosrm.model.values import (
    HostLossPolicy,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    ReschedulePolicy,
    RestartPolicy,
)
from tests.unit.core.cluster import GIB, Cluster, job, process


def failing(attempts: int = 2, delay: float = 0.0, **fields: object) -> ProcessSpec:
    """Return a service that is not restarted where it fails, but elsewhere."""
    return process("p", reschedule=ReschedulePolicy(attempts, delay), **fields)


def test_a_process_that_has_failed_starts_on_another_host() -> None:
    """The former host is excluded, with the reason, until the attempts are used up."""
    cluster = Cluster("a", "b", "c").with_processes(failing(attempts=1))
    (first,) = cluster.where("p")
    cluster.finish("p", on=first, code=3)
    (second,) = cluster.where("p")
    assert second != first
    (said,) = cluster.recorded("queued")
    attempt = "attempt 1 of 1 on another host follows"
    assert said == f"p returns to the queue: it failed on {first} (exit code 3); {attempt}"
    reasons = {one["name"]: one["reason"] for one in cluster.explain("p")["decision"]["hosts"]}
    assert reasons[first] == "p failed there: exit code 3"
    cluster.finish("p", on=second, code=3)
    assert cluster.phase("p") == "failed"


def test_without_attempts_a_failed_process_has_failed() -> None:
    """This is the default."""
    cluster = Cluster("a", "b").with_processes(process("p"))
    cluster.finish("p", on=cluster.where("p")[0], code=3)
    assert cluster.phase("p") == "failed"


def test_a_job_that_succeeds_is_not_started_elsewhere() -> None:
    """Only failures lead elsewhere."""
    cluster = Cluster("a", "b")
    cluster.submit(job("p", reschedule=ReschedulePolicy(2)))
    cluster.finish("p", on=cluster.where("p")[0])
    assert cluster.phase("p") == "finished"


def test_the_attempt_elsewhere_follows_its_delay_and_does_not_block_the_queue() -> None:
    """Processes behind it are placed before."""
    cluster = Cluster("a", "b").with_processes(failing(delay=5.0))
    (first,) = cluster.where("p")
    cluster.finish("p", on=first, code=3)
    cluster.submit(process("q"))
    assert (cluster.phase("q"), cluster.phase("p")) == ("running", "queued")
    assert cluster["p"].reason == "it is placed on another host after 5 s"
    cluster.wait(4.5)
    assert cluster.phase("p") == "queued"
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    assert cluster.where("p") != [first]


def test_delay_and_attempts_survive_a_restart_of_the_master() -> None:
    """The new master waits for the rest of the delay, and counts on."""
    cluster = Cluster("a", "b", "c").with_processes(failing(attempts=1, delay=5.0))
    (first,) = cluster.where("p")
    cluster.finish("p", on=first, code=3)
    cluster.wait(3.0)
    cluster.restart_master()
    cluster.wait(1.5)
    assert cluster.phase("p") == "queued"
    cluster.wait(1.0)
    (second,) = cluster.where("p")
    cluster.finish("p", on=second, code=3)
    assert cluster.phase("p") == "failed"


def test_the_hosts_on_which_it_failed_stay_excluded_after_a_restart_of_the_master() -> None:
    """Their slaves register again, but in the same run."""
    cluster = Cluster("a", "b").with_processes(failing(delay=5.0))
    (first,) = cluster.where("p")
    cluster.finish("p", on=first, code=3)
    cluster.restart_master()
    cluster.wait(6.0)
    assert cluster.where("p") not in ([], [first])


def test_a_new_run_of_the_slave_ends_the_exclusion_of_its_host() -> None:
    """The slave may have been repaired; also if the master was restarted before."""
    cluster = Cluster("a", "b").with_processes(failing())
    cluster.set_host("b", "cordon")
    cluster.finish("p", on=cluster.where("p")[0], code=3)
    cluster.restart_master()
    assert cluster.phase("p") == "set_aside"
    cluster.cut("a", seconds=2.0)
    assert cluster.restart_slave("a").accepted
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]


# --- no other host ------------------------------------------------------------------------------


@pytest.mark.parametrize("pruned", [False, True])
def test_a_process_that_no_other_host_may_ever_take_has_failed(pruned: bool) -> None:
    """The reason names the host on which it failed; a host that was removed does not count."""
    cluster = Cluster("a").with_processes(failing())
    if pruned:
        cluster.add("b")
        cluster.leave("b")
        assert cluster.ask(happened.PruneRequested, (), ("b",)).accepted
    cluster.finish("p", code=3)
    assert cluster.phase("p") == "failed"
    assert cluster["p"].reason == (
        "no host can start it: a: p failed there: exit code 3; there is no other host"
    )
    assert cluster.explain("p")["host"] == "a"
    assert cluster.explain("p")["reason"] == cluster["p"].reason
    assert cluster.explain("p")["advice"].startswith(
        "`rosrm logs p` shows its output, `rosrm restart p` starts it again"
    )


def failed_on_a(b: str) -> Cluster:
    """Return a cluster where p has failed on a, and b is `full` or `cordoned`."""
    cluster = Cluster("a").with_processes(failing(needs={"memory": 2 * GIB}))
    cluster.add("b")
    if b == "cordoned":
        cluster.set_host("b", "cordon")
    else:
        cluster.machines["b"].busy["memory"] = 0.75
        cluster.wait(0.2)
    cluster.finish("p", code=3)
    return cluster


def test_a_process_waits_for_room_on_another_host_and_says_where_it_failed() -> None:
    """`rosrm ps` and `rosrm explain` name the excluded host; the latter what to do."""
    cluster = failed_on_a("full")
    reason = "it failed on a (exit code 3), and no other host can take it now"
    assert (cluster.phase("p"), cluster["p"].reason) == ("queued", reason)
    (row,) = listing.process_rows(cluster.state, cluster.now)
    assert row.reason == reason
    explained = cluster.explain("p")
    assert explained["reason"] == reason
    assert explained["advice"] == (
        "`rosrm logs p` shows its output, `rosrm restart p` tries a again"
    )
    assert [one["reason"].partition(":")[0] for one in explained["decision"]["hosts"]] == [
        "p failed there", "memory"
    ]  # fmt: skip
    cluster.machines["b"].busy["memory"] = 0.1
    cluster.wait(0.5)
    assert cluster.where("p") == ["b"]


def test_a_process_is_set_aside_while_the_other_hosts_are_away() -> None:
    """The reason names each host; the process blocks no other, and starts when one returns."""
    cluster = failed_on_a("cordoned")
    reason = "no host may take it: a: p failed there: exit code 3; b is cordoned"
    assert (cluster.phase("p"), cluster["p"].reason) == ("set_aside", reason)
    assert "`rosrm restart p` tries a again" in cluster.explain("p")["advice"]
    cluster.submit(process("q"))
    assert cluster.where("q") == ["a"]
    cluster.set_host("b", "uncordon")
    cluster.wait(0.5)
    assert cluster.where("p") == ["b"]


@pytest.mark.parametrize("b", ["full", "cordoned"])
def test_a_restart_of_a_waiting_process_tries_the_hosts_again_on_which_it_failed(b: str) -> None:
    """With all attempts."""
    cluster = failed_on_a(b)
    assert cluster.restart("p").accepted
    assert cluster.where("p") == ["a"]
    assert cluster["p"].reschedules == 0


def test_a_restart_of_a_waiting_process_ends_its_delay() -> None:
    """The process is placed at once."""
    cluster = Cluster("a").with_processes(failing(delay=60.0))
    cluster.finish("p", code=3)
    assert cluster.restart("p").accepted
    assert cluster.where("p") == ["a"]


# --- attempts -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("run_time", "again"), [(11.0, True), (9.0, False)])
def test_a_last_run_as_long_as_the_window_gives_a_service_all_attempts_again(
    run_time: float, again: bool
) -> None:
    """A service that fails once a month would otherwise use up its attempts."""
    cluster = Cluster("a", "b")
    cluster.submit(failing(attempts=1, restart=RestartPolicy("never", window=10.0)))
    (host,) = cluster.where("p")
    cluster.finish("p", on=host, code=3, run_time=run_time)
    for _ in range(3):
        (host,) = cluster.where("p")
        cluster.wait(20.0)
        cluster.finish("p", on=host, code=3, run_time=run_time)
        if not again:
            assert cluster.phase("p") == "failed"
            return
        assert cluster.where("p") not in ([], [host])


def test_many_short_runs_give_no_attempts_again() -> None:
    """However long the restarts took: otherwise the process would be rescheduled forever."""
    cluster = Cluster("a", "b", "c")
    policy = RestartPolicy("on-failure", window=10.0)
    cluster.submit(failing(attempts=1, restart=policy))
    for _ in range(2):
        (host,) = cluster.where("p")
        for _ in range(5):
            cluster.wait(9.0)
            cluster.finish("p", on=host, code=3)  # restarted
        give_up(cluster, host, run_time=9.0)
    assert cluster.phase("p") == "failed"


def test_a_long_run_before_a_series_of_restarts_gives_all_attempts_again() -> None:
    """The run that counts may be one after which the process was restarted on its host."""
    cluster = Cluster("a", "b", "c")
    policy = RestartPolicy("on-failure", window=10.0)
    cluster.submit(failing(attempts=1, restart=policy))
    give_up(cluster, cluster.where("p")[0], run_time=1.0)
    (host,) = cluster.where("p")
    instance = cluster.machines[host].find("p")
    cluster.report(
        host, InstanceStatus(instance, InstanceState.STARTING, restarts=1, run_time=11.0)
    )
    give_up(cluster, host, run_time=1.0)
    assert cluster.where("p") not in ([], [host])


def give_up(cluster: Cluster, host: str, *, run_time: float) -> None:
    """End a run after which the restart policy gives up."""
    machine = cluster.machines[host]
    machine.programs[machine.find("p")].restart = RestartPolicy("never")
    cluster.finish("p", on=host, code=3, run_time=run_time)


def test_a_job_gets_no_attempts_again() -> None:
    """However long its runs are: each of them begins the same work again."""
    cluster = Cluster("a", "b", "c")
    cluster.submit(job("p", reschedule=ReschedulePolicy(1), restart=RestartPolicy(window=10.0)))
    for _ in range(2):
        cluster.wait(20.0)
        cluster.finish("p", on=cluster.where("p")[0], code=3, run_time=20.0)
    assert cluster.phase("p") == "failed"


def test_a_restart_by_a_user_gives_it_all_attempts_again() -> None:
    """And every host."""
    cluster = Cluster("a", "b").with_processes(failing(attempts=1))
    for _ in range(2):
        for _ in range(2):
            cluster.finish("p", on=cluster.where("p")[0], code=3)
        assert cluster.phase("p") == "failed"
        cluster.restart("p")


def test_the_policy_for_a_lost_host_decides_about_a_lost_host() -> None:
    """`host_loss: stop` fails the process, whatever `reschedule` says."""
    cluster = Cluster("a", "b").with_processes(failing(host_loss=HostLossPolicy("stop")))
    cluster.cut(cluster.where("p")[0], seconds=15.0)
    assert cluster.phase("p") == "failed"
