"""Limits of real processes: control groups of this machine, CPUs, scheduling."""

from __future__ import annotations

import os
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

from rosrm.core.supervisor.events import StopOrdered
from rosrm.core.supervisor.rules import LimitRule
from rosrm.model.values import InstanceState, Limits, RestartPolicy
from rosrm.runtime import cgroups
from rosrm.supervisor import group_trees
from rosrm.supervisor.client import SupervisorClient
from rosrm.supervisor.instance_groups import pids, remove_empty
from tests.waiting import PATIENCE, wait_gone, wait_until

from .conftest import kill

MB = 1_000_000
#: Says that it begins, then writes to each page of many bytes.
HOG = (
    "import sys; print('begun', flush=True); x = bytearray({0}); x[::4096] = b'1' * len(x[::4096])"
)
#: Says when it holds many bytes of memory, and sleeps.
HOLD = "import time; x = b'1' * {0}; print('holds', flush=True); time.sleep(1000)"
#: Starts a daemon with a session of its own and without environment, and says its pid.
DAEMON = """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.execve("/bin/sleep", ["sleep", "1000"], {})
    os._exit(0)
os.wait()
time.sleep(1000)
"""
ONE_RESTART = RestartPolicy("on-failure", delay=0.05, attempts=1)


@pytest.fixture(autouse=True)
def enforcement(tmp_path) -> group_trees.Enforcement:
    """Return what this machine can enforce; skip the test if that is nothing."""
    found = group_trees.find(str(tmp_path))
    if not {"limits.memory", "limits.cpu"}.isdisjoint(found.missing):
        pytest.skip("; ".join(found.missing.values()))
    return found


def group_of(client: SupervisorClient, name: str, controller: str = "memory") -> Path:
    """Return the group of an instance that has a controller."""
    tops = [top for _, top, controllers in client.groups if controller in controllers]
    return Path(tops[0]) / f"{name}.1"


def groups(client: SupervisorClient) -> list[Path]:
    """Return the groups of all instances."""
    return [group for _, top, _ in client.groups for group in Path(top).glob("*.*/")]


def wait_removed(client: SupervisorClient) -> None:
    """Wait until no instance has a group."""
    wait_until(lambda: not groups(client), "the removal of the groups")


def test_a_leak_is_killed_at_its_limit_and_restarted(host, client) -> None:
    """The end says how much the process used of how much; the restart policy applies."""
    limits = LimitRule(memory=30 * MB)
    client.start([host.python("leak", HOG.format(200 * MB), limits=limits, restart=ONE_RESTART)])
    backoff = host.wait(client, "leak", InstanceState.BACKOFF)
    assert backoff.message.startswith("killed: used 30.0 MB of 30.0 MB; restart 1 of 1")
    assert backoff.exit_signal == signal.SIGKILL
    assert host.ended(client, "leak").message.startswith("killed: used 30.0 MB of 30.0 MB")
    assert host.log("leak").read_text() == "begun\n" * 2
    wait_removed(client)


def test_a_process_below_its_limits_is_not_killed(host, client) -> None:
    """The limits are reported as enforced, and another signal is reported as before."""
    limits = LimitRule(memory=200 * MB, cpu=1.5)
    pid = host.sleeper(client, "calm", limits=limits)
    os.kill(pid, signal.SIGKILL)
    status = host.ended(client, "calm")
    assert (status.enforced, status.message) == (
        ("limits.memory", "limits.cpu"),
        "killed by SIGKILL",
    )


def test_a_process_beyond_its_cpu_limit_waits(host, client) -> None:
    """The kernel throttles it."""
    client.start([host.python("busy", "while True: pass", limits=LimitRule(cpu=0.1))])
    host.running(client, "busy")
    statistics = group_of(client, "busy", "cpu") / "cpu.stat"

    wait_until(
        lambda: "nr_throttled 0\n" not in statistics.read_text(), "the pause of a busy process"
    )


def read(client: SupervisorClient, name: str) -> tuple[str, str]:
    """Return the limits of memory and CPU time that the kernel has of an instance.

    An instance without a group of the controller cpu is not limited.
    """
    memory, cpu = (group_of(client, name, controller) for controller in ("memory", "cpu"))
    for files in ("memory.limit_in_bytes", "cpu.cfs_quota_us"), ("memory.max", "cpu.max"):
        if (memory / files[0]).exists():
            of_cpu = (cpu / files[1]).read_text().strip() if cpu.is_dir() else "-1"
            return (memory / files[0]).read_text().strip(), of_cpu
    raise AssertionError(f"{memory} has no limit")


def test_limits_change_while_a_process_runs(host, client) -> None:
    """They are raised, lowered and removed, also by the supervisor that follows a killed one."""
    unlimited = host.sleeper(client, "unlimited") and read(client, "unlimited")
    order = host.python("calm", HOLD.format(20 * MB), limits=LimitRule(memory=60 * MB))
    client.start([order])
    pid = host.running(client, "calm").pid
    seen = []
    for limits in (
        Limits(memory=100 * MB, cpu=1.5), Limits(memory=50 * MB, cpu=0.03), Limits(cpu=1.0),
        Limits(),
    ):  # fmt: skip
        assert host.amend(client, "calm", ONE_RESTART, limits) == ""
        seen.append(read(client, "calm"))
        assert pid in pids(str(group_of(client, "calm", "cpu")))
        client = host.replace_supervisor(client)
        (status,) = (one for one in client.instances if one.pid == pid)
        given = {"limits.memory": limits.memory, "limits.cpu": limits.cpu}
        assert status.enforced == tuple(name for name, value in given.items() if value)
    memory = [int(of_memory) // MB for of_memory, _ in seen[:2]]
    assert memory == [99, 49]  # in whole pages
    assert len({of_cpu for _, of_cpu in seen}) == len(seen)
    assert (seen[2][0], seen[3]) == (unlimited[0], unlimited)


def test_a_limit_below_what_a_process_uses_is_refused(host, client) -> None:
    """Nothing changes, the limits of the next run included."""
    first = LimitRule(memory=60 * MB, cpu=1.0)
    client.start([host.python("full", HOLD.format(30 * MB), limits=first, restart=ONE_RESTART)])
    pid = host.running(client, "full").pid
    wait_until(lambda: host.log("full").read_text() == "holds\n", "that it holds its memory")
    before = read(client, "full")
    refusal = host.amend(client, "full", ONE_RESTART, Limits(memory=10 * MB, cpu=0.5))
    assert "and the limit is 10.0 MB" in refusal
    assert read(client, "full") == before
    kill(pid)
    host.wait(client, "full", InstanceState.BACKOFF)
    host.running(client, "full")
    assert read(client, "full") == before


def test_new_limits_hold_for_the_next_run(host, client) -> None:
    """An instance that waits for its restart has no control group to change."""
    slow = RestartPolicy("on-failure", delay=0.5)
    pid = host.sleeper(client, "again", restart=slow)
    kill(pid)
    host.wait(client, "again", InstanceState.BACKOFF)
    assert host.amend(client, "again", slow, Limits(memory=50 * MB)) == ""
    assert host.running(client, "again").enforced == ("limits.memory",)


def test_cpus_scheduling_and_niceness_are_set_before_the_program_runs(host, client) -> None:
    """Its first instruction runs with them, so each thread and child has them."""
    last = max(os.sched_getaffinity(0))
    code = (
        "import os; print(os.sched_getaffinity(0), os.sched_getscheduler(0), "
        "os.sched_getparam(0).sched_priority)"
    )
    host.run(client, host.python("pinned", code, limits=LimitRule(cpus=(last,))))
    assert host.log("pinned").read_text() == f"{{{last}}} {os.SCHED_OTHER} 0\n"
    assert os.sched_getaffinity(client.pid) == os.sched_getaffinity(0)

    status = host.run(client, host.python("quick", code, limits=LimitRule(policy="rr", priority=7)))
    if "realtime" not in client.unenforced:
        assert (status.enforced, status.message) == (("realtime",), "")
        assert host.log("quick").read_text().endswith(f" {os.SCHED_RR} 7\n")

    nice = os.nice(0) + 3
    polite = host.python("polite", "import os; print(os.nice(0))", limits=LimitRule(nice=nice))
    assert host.run(client, polite).enforced == ("nice",)
    assert host.log("polite").read_text() == f"{nice}\n"


@pytest.mark.parametrize("required", [True, False])
def test_a_cpu_that_the_host_lacks_is_refused(host, client, required: bool) -> None:
    """The master then tries another host."""
    limits = LimitRule(cpus=(0, 4000, 4001), required=required)
    status = host.run(client, host.order("pinned", "true", limits=limits))
    assert status.state is InstanceState.REFUSED
    assert status.message == "this host has no CPUs 4000 and 4001 for its processes"


def test_a_stop_ends_a_daemon_that_hides(host, client) -> None:
    """A daemon with an own session and without environment is in the group of its instance."""
    client.start([host.python("parent", DAEMON)])
    leader = host.running(client, "parent").pid
    group = group_of(client, "parent")
    wait_until(lambda: len(pids(str(group))) == 2, "the daemon")
    (daemon,) = set(pids(str(group))) - {leader}
    os.kill(leader, signal.SIGKILL)
    assert host.ended(client, "parent").exit_signal == signal.SIGKILL
    wait_gone(daemon)
    wait_removed(client)


@pytest.mark.parametrize("replaced", [False, True], ids=["same supervisor", "next supervisor"])
def test_a_held_instance_that_is_stopped_leaves_no_group(host, client, replaced: bool) -> None:
    """Its groups are made ahead, and the next supervisor finds them."""
    pid = host.sleeper(client, "first")
    client.start([host.order("next", "true", slots=1, limits=LimitRule(memory=30 * MB))])
    host.wait(client, "next", InstanceState.HELD)
    client = host.replace_supervisor(client) if replaced else client
    client.send(StopOrdered(("next", 1)))
    host.ended(client, "next")
    kill(pid)
    host.ended(client, "first")
    wait_removed(client)


def test_leftovers_of_a_first_start_that_failed_are_killed(host, client) -> None:
    """Otherwise they would run beside the next attempt."""
    pid = host.sleeper(client, "first")
    client.start([host.order("next", "true", slots=1, restart=RestartPolicy("always", delay=60.0))])
    host.wait(client, "next", InstanceState.HELD)
    log, group = host.log("next"), group_of(client, "next")
    wait_until(lambda: group.is_dir() and log.is_file(), "group and log of the held instance")
    log.unlink()
    log.mkdir()  # the start fails
    with subprocess.Popen(["sleep", "1000"]) as leftover:
        try:
            cgroups.write(str(group / "cgroup.procs"), str(leftover.pid))
            kill(pid)
            host.wait(client, "next", InstanceState.BACKOFF)
            assert leftover.wait(PATIENCE) == -signal.SIGKILL
        finally:
            leftover.kill()
    client.send(StopOrdered(("next", 1)))
    host.ended(client, "next")
    wait_removed(client)


def test_the_next_supervisor_finds_the_groups_again(host, client) -> None:
    """Limits hold on, a group whose instance has ended is removed, and a stop kills the rest."""
    limits = LimitRule(memory=30 * MB)
    pid = host.sleeper(client, "lasting", limits=limits)
    gone = host.sleeper(client, "gone", limits=limits)
    client.start([host.python("parent", DAEMON)])
    parent = host.running(client, "parent").pid
    wait_until(lambda: len(pids(str(group_of(client, "parent")))) == 2, "the daemon")
    host.kill_supervisor(client)
    for ended in (gone, parent):
        os.kill(ended, signal.SIGKILL)
        wait_gone(ended)

    client = host.connect()
    assert host.ended_after_connect(client, "gone").state is InstanceState.FAILED
    assert host.ended_after_connect(client, "parent").state is InstanceState.FAILED
    wait_until(lambda: {one.name for one in groups(client)} == {"lasting.1"}, "the removal")
    assert pids(str(group_of(client, "lasting"))) == [pid]
    assert next(one for one in client.instances if one.pid == pid).enforced == ("limits.memory",)


def test_a_kill_while_no_supervisor_runs_is_reported(host, client, tmp_path) -> None:
    """The next supervisor reads it from the group of the instance.

    The supervisor of another test that starts in between removes the empty group. So it is tried
    until none did, which takes about a second each time.
    """
    reports = []
    for name in (f"leak_{number}" for number in range(20)):
        go = tmp_path / name
        wait = f"import os, time\nwhile not os.path.exists({str(go)!r}): time.sleep(0.01)\n"
        limits = LimitRule(memory=30 * MB)
        client.start([host.python(name, wait + HOG.format(200 * MB), limits=limits)])
        pid = host.running(client, name).pid
        host.kill_supervisor(client)
        go.touch()
        wait_gone(pid)
        client = host.connect()
        reports.append(host.ended_after_connect(client, name).message)
        if reports[-1].startswith("killed: used 30.0 MB of 30.0 MB"):
            return
    raise AssertionError(f"no kill was reported: {reports}")


def test_supervisors_side_by_side_keep_apart(host, client, tmp_path) -> None:
    """Equal names of instances of two supervisors have groups of their own."""
    other = type(host)(tmp_path / "other")
    try:
        second = other.connect()
        pid, other_pid = host.sleeper(client, "twin"), other.sleeper(second, "twin")
        assert pids(str(group_of(client, "twin"))) == [pid]
        assert pids(str(group_of(second, "twin"))) == [other_pid]
        other.kill_supervisor(second)
        os.kill(other_pid, signal.SIGKILL)
        wait_gone(other_pid)
        abandoned = group_of(second, "twin").parent
        client = host.replace_supervisor(client)
        assert not abandoned.exists()
        assert pids(str(group_of(client, "twin"))) == [pid]
    finally:
        other.clean_up()


def test_a_supervisor_whose_group_was_removed_makes_it_again(host, client) -> None:
    """Another supervisor may remove the group while no instance is in it."""
    host.run(client, host.order("first", "true"))
    wait_removed(client)
    for _, top, _ in client.groups:
        remove_empty(top)
    pid = host.sleeper(client, "second")
    assert pids(str(group_of(client, "second"))) == [pid]


def test_limits_are_found_while_another_supervisor_removes_empty_groups(
    enforcement, tmp_path
) -> None:
    """A supervisor that starts removes the empty groups of all others."""
    ended = Event()

    def remove() -> None:
        while not ended.is_set():
            for tree in enforcement.trees:
                remove_empty(tree.top)

    with ThreadPoolExecutor() as threads:
        removing = threads.submit(remove)
        try:
            found = [group_trees.find(str(tmp_path)).missing for _ in range(300)]
        finally:
            ended.set()
        removing.result(PATIENCE)
    assert found == [enforcement.missing] * 300


def test_nothing_is_left_of_a_supervisor_that_has_ended(host, client) -> None:
    """Its group is removed, too."""
    host.run(client, host.order("job", "true", limits=LimitRule(memory=30 * MB)))
    tops = [Path(top) for _, top, _ in client.groups]
    client.close()
    wait_gone(client.pid)
    assert not any(top.exists() for top in tops)
