"""Orderly stops of master and slave: Ctrl-C, SIGTERM, SIGHUP, `--stop-all`, a closed terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import time

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import RestartPolicy, StopPolicy
from tests.ros.clusters import PATIENCE, alive, host, job, service, wait_until_none
from tests.waiting import wait_until

#: Signals of Ctrl-C and of `kill`. SIGHUP stops only with a terminal, as below.
STOPS = [signal.SIGINT, signal.SIGTERM]


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"))


@pytest.mark.parametrize("number", STOPS)
def test_a_slave_that_is_stopped_stops_its_processes(cluster, number) -> None:
    """A stopped slave exits with 0, no traceback, no process left; its processes are queued.

    The master acknowledges the last statuses at once, so the slave waits less than its 2 s for
    that.
    """
    names = ["p0", "p1", "p2", "p3"]
    restart = RestartPolicy("always", delay=0.1)
    cluster.submit(*(service(name, restart=restart) for name in names))
    pids = [cluster.wait(name, "running").pid for name in names]
    written = len(cluster.log_of("h0"))

    assert cluster.end(cluster.slaves["h0"], number) == 0

    assert not [pid for pid in pids if alive(pid)]
    assert wait_until_none(cluster.directory / "hosts") == {}
    log = cluster.log_of("h0")[written:]
    assert "Traceback" not in log
    assert "did not acknowledge" not in log
    assert f"stopping 4 processes ({number.name})" in log
    assert "slave of h0 ended; 4 processes were stopped" in log
    for name in names:
        cluster.wait(name, "queued")
    assert [row.state for row in cluster.client.list(hosts=True).hosts] == ["left"]
    cluster.add(host("h0"))
    assert cluster.wait("p3", "running").host == "h0"
    cluster.cancel(*names)


@pytest.mark.parametrize("number", STOPS)
def test_a_master_that_is_stopped_touches_no_process(cluster, number) -> None:
    """A stopped master exits with 0, without a traceback; the next one has the same processes."""
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    written = len(cluster.log_of("master"))

    assert cluster.end(cluster.master, number) == 0
    log = cluster.log_of("master")[written:]
    assert "Traceback" not in log
    assert f"ended ({number.name}); 1 process keeps running; start the master again" in log
    assert alive(before.pid)

    cluster.reconnect()
    cluster.start_master()
    after = cluster.wait("p", "running")
    assert (after.pid, after.number, after.host) == (before.pid, before.number, before.host)
    cluster.wait_for_hosts()
    cluster.cancel("p")


def test_logs_of_parts_that_are_stopped_together(cluster) -> None:
    """Neither log claims that processes keep running; a second signal lists the remaining ones.

    The slave can only handle the second signal after it has begun to stop.
    """
    deaf = "trap '' INT TERM; echo deaf; while :; do sleep 0.1; done"
    cluster.submit(service("deaf", "sh", "-c", deaf, stop=StopPolicy(3.0, 3.0)))
    cluster.wait_for_log("deaf", "deaf")
    master, slave = cluster.master, cluster.slaves["h0"]
    written = {part.name: len(cluster.log_of(part.name)) for part in (master, slave)}

    def log_of(part) -> str:
        return cluster.log_of(part.name)[written[part.name] :]

    slave.end(signal.SIGINT)
    wait_until(lambda: "h0 leaves" in log_of(master), "the master knows")
    assert cluster.end(master, signal.SIGINT) == 0
    assert cluster.end(slave, signal.SIGINT) == 0

    ended = log_of(master).rpartition("master ")[2]
    assert "ended (SIGINT); 1 process is still being stopped by the slave of h0" in ended
    log = log_of(slave)
    assert "stopping 1 process (SIGINT); processes that run after 6 s are killed" in log
    assert re.search(r"still stopping deaf#\d+; processes that run after ", log)
    assert "slave of h0 ended; 1 process was stopped" in log
    assert "running" not in log.partition("stopping 1 process")[2]
    assert wait_until_none(cluster.directory / "hosts") == {}
    cluster.reconnect()
    cluster.start_master()
    cluster.add(host("h0"))


@pytest.fixture(scope="module")
def alert(make_shared):
    """Yield a cluster whose slave notices a silent master after a second."""
    return make_shared(host("h0"), liveness=LivenessSettings())


@pytest.mark.parametrize("after", [0.0, 1.3])
def test_a_slave_that_is_stopped_after_its_master_loses_no_process(alert, after) -> None:
    """Processes of a slave that is stopped after its master are queued when both are back.

    The slave may notice the silence of the master while it stops.
    """
    cluster, names = alert, ("p", "q")
    again = RestartPolicy("on-failure", delay=0.1)
    cluster.submit(service("p"), service("q", restart=again))
    before = {name: cluster.wait(name, "running").number for name in names}
    written = len(cluster.log_of("h0"))
    assert cluster.end(cluster.master, signal.SIGINT) == 0
    time.sleep(after)  # the instant of the stop is under test
    assert cluster.end(cluster.slaves["h0"], signal.SIGINT) == 0
    assert wait_until_none(cluster.directory / "hosts") == {}
    stopping = cluster.log_of("h0")[written:].partition("stopping 2 processes")[2]
    assert "slave of h0 ended; 2 processes were stopped" in stopping
    assert "keep running" not in stopping

    cluster.reconnect()
    cluster.start_master()
    cluster.add(host("h0"))
    for name, number in before.items():
        cluster.wait(name, "running", where=lambda row, number=number: row.number > number)
    assert not cluster.events("failed")
    cluster.cancel(*names)


@pytest.fixture(scope="module")
def keeping(make_shared):
    """Yield a cluster whose host has `on_stop: keep`."""
    return make_shared(host("h0", on_stop="keep"))


def test_keep_leaves_the_processes_running(keeping) -> None:
    """With `on_stop: keep` processes outlive their slave, and the next slave re-adopts them."""
    cluster = keeping
    go = cluster.directory / "go"
    script = f"while [ ! -e {go} ]; do sleep 0.05; done; exit 3"
    cluster.submit(service("p"), job("short", "sh", "-c", script))
    before = cluster.wait("p", "running")
    cluster.wait("short", "running")

    assert cluster.end(cluster.slaves["h0"], signal.SIGINT) == 0
    assert alive(before.pid)
    log = cluster.log_of("h0")
    assert "slave of h0 ended (SIGINT); 2 processes keep running (supervisor pid " in log
    assert "`rosrm slave --stop-all`" in log
    view = cluster.client.list(hosts=True, processes=True)
    assert [row.state for row in view.hosts] == ["detached"]
    assert {row.state for row in view.processes} == {"unreachable"}
    go.touch()  # it ends while there is no slave

    cluster.add(cluster.hosts[0])
    assert cluster.wait("p", "running").pid == before.pid
    row = cluster.ended("short")
    assert (row.state, row.exit_code) == ("failed", 3)
    assert "1 process still runs, 1 has ended" in cluster.log_of("h0")
    cluster.cancel("p")


def test_a_slave_without_processes_to_keep_leaves(keeping) -> None:
    """With `on_stop: keep` and no process, host and supervisor leave at once."""
    cluster = keeping
    assert cluster.run(job("done", "true"))[0].state == "finished"
    assert cluster.end(cluster.slaves["h0"], signal.SIGTERM) == 0
    assert "slave of h0 ended; no processes were stopped" in cluster.log_of("h0")
    assert wait_until_none(cluster.directory / "hosts") == {}
    assert [row.state for row in cluster.client.list(hosts=True).hosts] == ["left"]
    cluster.add(cluster.hosts[0])


@pytest.mark.parametrize("role", ["master", "slave"])
def test_interrupted_while_it_starts(make_cluster, role) -> None:
    """Ctrl-C at any instant of the start gives no traceback and leaves nothing."""
    cluster = make_cluster(started=role == "slave")
    for delay in (0.0, 0.02, 0.05, 0.1, 0.15, 0.3, 0.5, 0.8, 1.2):
        part = cluster.start_master() if role == "master" else cluster.start_slave(host("h0"))
        time.sleep(delay)  # the instants in between are under test
        code = cluster.end(part, signal.SIGINT)
        assert code in (0, -signal.SIGINT), cluster.log_of(part.name)
        assert "Traceback" not in cluster.log_of(part.name)
        left = wait_until_none(cluster.directory / "hosts")
        assert not left, f"after {delay} s: {left}"
    if role == "slave":
        del cluster.slaves["h0"]


# --- the shell --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def empty(make_shared):
    """Yield a cluster without hosts."""
    return make_shared()


def command_of(cluster, *settings: str) -> list[str]:
    """Return the command of the slave of a host t, which has these further settings."""
    lines = [
        "host: t", "scope: slice", "budget: {memory: 1GiB, cpu: 4}",
        f"state: {cluster.directory / 'hosts' / 't'}", "probes: {memory: {}, cpu: {}}",
        f"ros: {{domain: {cluster.domain}}}", *settings,
    ]  # fmt: skip
    config = cluster.directory / "host.yaml"
    config.write_text("\n".join(lines))
    return [sys.executable, "-m", "rosrm.cli", "slave", "--config", str(config)]


@contextlib.contextmanager
def slave_of(cluster, command: list[str]):
    """Start a slave by its command, and wait for its host; it must end with exit code 0."""
    with (cluster.directory / "t.log").open("wb") as sink, subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink
    ) as slave:  # fmt: skip
        try:
            cluster.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
            yield
        finally:
            slave.terminate()
            code = slave.wait(PATIENCE)
    assert code == 0


def keep_two(cluster) -> tuple[list[str], list[int]]:
    """Let a stopped slave keep the services p and q; return its command, and their pids."""
    command = command_of(cluster, "on_stop: keep")
    with slave_of(cluster, command):
        cluster.submit(service("p"), service("q"))
        pids = [cluster.wait(name, "running").pid for name in ("p", "q")]
    return command, pids


def stop_all(command: list[str], *, refused: bool = False) -> str:
    """Run `--stop-all`, and return its output."""
    done = subprocess.run(
        [*command, "--stop-all"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert (done.returncode != 0) == refused, done.stdout
    assert "Traceback" not in done.stdout
    return done.stdout


def test_stop_all_ends_and_reports_kept_processes(empty) -> None:
    """`--stop-all` completes a pending cancellation; other processes are queued again."""
    command, pids = keep_two(empty)
    assert "being cancelled: waits for t, whose slave was stopped" in empty.client.cancel(["p"])
    assert "whose slave was stopped" in empty.process("p").reason
    assert "supervisor of t ended; 2 processes were stopped" in stop_all(command)
    assert not [pid for pid in pids if alive(pid)]
    assert empty.ended("p").state == "cancelled"
    empty.wait("q", "queued")
    assert [row.state for row in empty.client.list(hosts=True).hosts] == ["left"]
    assert "no processes were stopped" in stop_all(command)
    empty.cancel("q")


def test_stop_all_without_a_master(make_cluster) -> None:
    """The processes end without a master, which learns of this from the next slave."""
    cluster = make_cluster()
    command, pids = keep_two(cluster)
    assert cluster.end(cluster.master, signal.SIGTERM) == 0
    said = stop_all(command)
    assert "2 processes were stopped" in said
    assert "the master was not reached within 5 s and does not know of these ends" in said
    assert said.count("looking for a master") == 1
    assert not [pid for pid in pids if alive(pid)]


def test_stop_all_is_refused_while_the_slave_runs(empty) -> None:
    """`--stop-all` is refused while the slave runs, because its end stops the processes."""
    command = command_of(empty)
    with slave_of(empty, command):
        assert "Stop it first" in stop_all(command, refused=True)


def test_a_terminal_that_is_closed(empty) -> None:
    """After SIGHUP the slave cannot write to its terminal, and still stops its processes."""
    terminal, its_end = pty.openpty()
    slave = subprocess.Popen(
        ["setsid", "--ctty", *command_of(empty)], stdin=its_end, stdout=its_end, stderr=its_end
    )
    os.close(its_end)
    try:
        empty.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
        empty.submit(service("closed"))
        pid = empty.wait("closed", "running").pid
    finally:
        os.close(terminal)
        code = slave.wait(PATIENCE)
    assert code == 0
    assert not alive(pid)
    assert wait_until_none(empty.directory / "hosts") == {}
    empty.cancel("closed")
