"""Limits of processes on real slaves: enforced, reported, and required where they cannot be."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.client.waiting import wait_for_applications
from rosrm.model.applications import RolloutPolicy, Target
from rosrm.model.values import Limits, RestartPolicy
from rosrm.supervisor import group_trees
from tests.ros.clusters import STEADY, host, job, python, service
from tests.waiting import PATIENCE

MB = 1_000_000
#: Says that it begins, then writes to each page of many bytes.
LEAK = "print('begun', flush=True); x = bytearray({0}); x[::4096] = b'1' * len(x[::4096])"
#: Holds many bytes.
HOLD = "import time; x = b'1' * {0}; time.sleep(1000)"
#: Shares many bytes with a child, which is a session of its own; both then sleep.
SHARED = """
import mmap, os, time
shared = mmap.mmap(-1, {0})
shared.write(b'1' * {0})
if os.fork() == 0:
    os.setsid()
    sum(shared[::4096])
time.sleep(1000)
"""


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Start one slave, on a machine that can enforce limits."""
    missing = group_trees.find(str(Path.cwd())).missing
    if not {"limits.memory", "limits.cpu"}.isdisjoint(missing):
        pytest.skip("; ".join(missing.values()))
    return make_shared(host("a"))


def test_a_leak_is_reported_as_what_it_is(cluster) -> None:
    """The process restarts, then it has failed; `explain` shows the limits that held."""
    restart = RestartPolicy("on-failure", delay=0.05, attempts=1)
    limits = Limits(memory=40 * MB, enforce="required")
    cluster.submit(python("leak", LEAK.format(400 * MB), limits=limits, restart=restart))
    killed = "killed: used 40.0 MB of 40.0 MB"
    assert cluster.ended("leak").reason.startswith(f"{killed}; its restart policy allows 1 restart")
    cluster.wait_for_event("backoff", f"{killed}; restart 1 of 1", process="leak")


def test_limits_that_hold_are_listed_and_outlive_slave_and_supervisor(cluster) -> None:
    """Listings of the next slave show them, too, and all processes of the instance end with it."""
    limits = Limits(memory=200 * MB, cpu=1.5)
    cluster.submit(python("shares", SHARED.format(50 * MB), limits=limits))
    held = {"memory_limit": 200 * MB, "cpu_limit": 1.5}
    used = cluster.wait("shares", "running", where=lambda row: row.memory > 50 * MB, **held).memory
    assert used < 90 * MB, "shared pages count once"
    explanation = cluster.client.explain("shares")
    assert [one["holds"] for one in explanation["limits"].values()] == [True, True]

    cluster.start_slave_again("a")
    row = cluster.wait("shares", "running", where=lambda row: row.memory > 50 * MB, **held)
    assert row.restarts == 0
    cluster.cancel("shares")


def test_an_application_changes_the_limits_of_a_process_that_runs_on(cluster) -> None:
    """Limits that it exceeds are refused, and those before them hold on."""

    def apply(**limits: float) -> str:
        spec = python("holds", HOLD.format(50 * MB), limits=Limits(**limits), application="limits")
        cluster.client.apply([Target("limits", (spec,), rollout=RolloutPolicy(healthy_for=0.0))])
        quiet = {"on_change": lambda _: None, "notify": lambda _: None}
        rows = wait_for_applications(cluster.client, ["limits"], timeout=PATIENCE, **quiet)
        return "" if rows[0].returned_from is None else rows[0].returned_from.given_up

    assert apply(memory=200 * MB) == ""
    pid = cluster.wait("holds", "running", where=lambda row: row.memory > 50 * MB).pid
    assert apply(memory=100 * MB, cpu=0.5) == ""
    held = {"pid": pid, "memory_limit": 100 * MB, "cpu_limit": 0.5}
    cluster.wait("holds", "running", **held)
    assert "and the limit is 20.0 MB" in apply(memory=20 * MB)
    cluster.wait("holds", "running", **held)
    cluster.cancel("holds")


def test_a_host_that_lacks_a_cpu_takes_no_process_that_requires_it(cluster) -> None:
    """The reason names the CPU and those that the host has."""
    cluster.submit(service("pinned", cpus=(4000,)))
    row = cluster.wait("pinned", "set_aside")
    assert "has no CPU 4000; it has 0" in row.reason
    cluster.cancel("pinned")


def test_a_process_is_pinned_and_nice(cluster) -> None:
    """Its program sees both."""
    last = max(os.sched_getaffinity(0))
    code = "import os; print(os.sched_getaffinity(0), os.nice(0))"
    nice = os.nice(0) + 3
    cluster.run(python("polite", code, cpus=(last,), nice=nice, restart=RestartPolicy("never")))
    assert f"{{{last}}} {nice}" in cluster.log("polite")


@pytest.fixture
def without_control_groups(tmp_path: Path, monkeypatch) -> None:
    """Start all parts of a cluster where no control groups are mounted."""
    wrapper = tmp_path / "python"
    inside = f'umount -R -l /sys/fs/cgroup; exec {sys.executable} "$@"'
    wrapper.write_text(f"#!/bin/sh\nexec unshare -m sh -c '{inside}' sh \"$@\"\n")
    wrapper.chmod(0o755)
    check = subprocess.run([wrapper, "-c", ""], capture_output=True, check=False)
    if check.returncode or check.stderr:
        pytest.skip(f"no mount namespace without control groups: {check.stderr!r}")
    monkeypatch.setattr(sys, "executable", str(wrapper))


def test_a_slave_that_can_enforce_nothing_says_so_once(
    without_control_groups, make_cluster
) -> None:
    """A process that requires limits waits for another host; one that does not runs without."""
    cluster = make_cluster(host("a"), liveness=STEADY)
    assert cluster.log_of("a").count("not enforced here: limits.memory") == 1
    cluster.submit(service("strict", limits=Limits(memory=200 * MB, enforce="required")))
    reason = "cannot enforce limits.memory: "
    assert reason in cluster.wait("strict", "set_aside").reason
    cluster.cancel("strict")
    assert cluster.run(job("lax", "true", limits=Limits(memory=200 * MB)))[0].state == "finished"
