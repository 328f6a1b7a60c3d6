"""A supervisor that for a while can open no file: no start, exit code or stop is lost."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.model.values import InstanceState, RestartPolicy
from tests.waiting import wait_gone, wait_until

#: A leader that ends at a signal, and leaves a child that ignores SIGINT.
LEAVES = """
(trap '' INT; exec sleep 1000) &
child=$!
trap 'exit 5' USR1
echo $child > child
while :; do sleep 0.01; done
"""
#: A program that ends with a code at a signal.
ENDS = """
import os, signal
signal.signal(signal.SIGUSR1, lambda *_: os._exit({}))
print(1, flush=True)
while True:
    signal.pause()
"""
FINAL = {"job0": 3, "job1": 4}


@contextlib.contextmanager
def no_descriptors(pid: int, but: int = 0) -> Iterator[None]:
    """Let a process open few files in this context, as where the table of the system is full."""
    former = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    used = max(int(file.name) for file in Path(f"/proc/{pid}/fd").iterdir()) + 1 if but else 0
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (used + but, former[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, former)


def own_log_has(host, text: str) -> bool:
    return text in (host.state / "supervisor.log").read_text()


@pytest.fixture
def talks(host, client):
    """Two jobs that end with a code of their own at SIGUSR1."""
    pids = {}
    for name, code in FINAL.items():
        client.start([host.python(name, ENDS.format(code), restart=RestartPolicy("never"))])
        pids[name] = host.running(client, name).pid
        wait_until(lambda name=name: host.log(name).read_text(), "the handler")
    return pids


def test_exit_codes_arrive_later(host, client, talks):
    """The supervisor notices an end, but cannot look for other processes of the instance yet."""
    with no_descriptors(client.pid):
        for pid in talks.values():
            os.kill(pid, signal.SIGUSR1)
            wait_gone(pid)
        wait_until(lambda: own_log_has(host, "Too many open files"), "the failure")
    codes: dict[str, int] = {}

    def both() -> bool:
        statuses = client.receive(1.0)  # one batch may have both
        codes.update((one.instance.process, one.exit_code) for one in statuses if one.state.ended)
        return len(codes) == len(FINAL)

    wait_until(both, "the ends", seen=lambda: codes)
    assert codes == FINAL


def test_the_end_of_a_process_taken_over_arrives_later(host, client):
    """The end is not lost although the pidfd reports it only once."""
    pid = host.sleeper(client, "sleeps", restart=RestartPolicy("never"))
    client = host.replace_supervisor(client)
    with no_descriptors(client.pid):
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: own_log_has(host, "Too many open files"), "the failure")
    assert host.ended(client, "sleeps").state is InstanceState.FAILED


def test_starts_are_tried_again(host, client):
    """Each start fails for now, and its restart policy tries it again."""
    restart = RestartPolicy("on-failure", delay=0.05, attempts=1000)
    with no_descriptors(client.pid):
        client.start([host.order(f"again{n}", "true", restart=restart) for n in range(9)])
        assert "Too many open files" in host.run(client, host.order("once", "true")).message
    ended: set[str] = set()
    wait_until(
        lambda: ended.update(
            one.instance.process for one in client.receive(1.0) if one.state.ended
        ) or len(ended) == 9,
        "the ends", seen=lambda: ended,
    )  # fmt: skip


def test_each_step_of_a_start_may_lack_the_descriptor(host, client):
    """A start with the log open, but without a descriptor for its fork, has an outcome too."""
    for free in range(8):
        with no_descriptors(client.pid, free):
            status = host.run(client, host.order(f"job{free}", "true"))
        assert status.state is InstanceState.EXITED or "Too many open files" in status.message
    assert status.state is InstanceState.EXITED


def test_a_stop_of_what_a_leader_left_ends(host, client):
    """The last process of the instance ends while nothing can be looked for."""
    client.start([host.order("leaves", "bash", "-c", LEAVES, restart=RestartPolicy("never"))])
    pid = host.running(client, "leaves").pid
    wait_until((host.state / "work" / "child").exists, "the child")
    os.kill(pid, signal.SIGUSR1)
    host.wait(client, "leaves", InstanceState.STOPPING)
    with no_descriptors(client.pid):
        os.kill(int((host.state / "work" / "child").read_text()), signal.SIGKILL)
        wait_until(lambda: own_log_has(host, "Too many open files"), "the failure")
    assert host.ended(client, "leaves").exit_code == 5
