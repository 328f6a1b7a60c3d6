"""Reschedule: a process that has failed on one host starts on another one."""

from __future__ import annotations

from rosrm.model.values import HostLossPolicy, ProcessSpec, ReschedulePolicy, RestartPolicy
from tests.unit.core.cluster import Cluster, job, process


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


def test_a_process_without_another_host_has_failed() -> None:
    """The reason names the host on which it failed."""
    cluster = Cluster("a").with_processes(failing())
    cluster.finish("p", code=3)
    assert cluster.phase("p") == "failed"
    assert cluster["p"].reason.startswith("no host can start it: a: p failed there: exit code 3")


def test_a_run_as_long_as_the_window_of_its_restarts_gives_it_all_attempts_again() -> None:
    """A service that fails once a month would otherwise use up its attempts."""
    cluster = Cluster("a", "b")
    cluster.submit(failing(attempts=1, restart=RestartPolicy("never", window=10.0)))
    for _ in range(3):
        (host,) = cluster.where("p")
        cluster.wait(11.0)
        cluster.finish("p", on=host, code=3)
        assert cluster.where("p") not in ([], [host])


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
