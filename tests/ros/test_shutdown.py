"""Ends of every part: Ctrl-C, SIGTERM, SIGHUP, second masters and slaves, kills."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import RestartPolicy, StopPolicy
from tests.ros.clusters import (
    PATIENCE,
    STEADY,
    alive,
    host,
    job,
    pids_of,
    service,
    wait_gone,
    wait_until,
    wait_until_none,
)

#: Signals of Ctrl-C, of `kill`, and of a closed terminal.
STOPS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def end(part, number) -> int:
    part.process.send_signal(number)
    return part.process.wait(PATIENCE)


@pytest.mark.parametrize("number", STOPS)
def test_a_slave_that_is_stopped_stops_its_processes(make_cluster, number) -> None:
    """A stopped slave exits with 0, no traceback, no process left; its processes are queued.

    The master acknowledges the last statuses at once, so the slave waits less than its 2 s for
    that.
    """
    cluster = make_cluster(host("h0"))
    restart = RestartPolicy("always", delay=0.1)
    cluster.submit(*(service(f"p{n}", restart=restart) for n in range(4)))
    pids = [cluster.wait(f"p{n}", "running").pid for n in range(4)]

    assert end(cluster.slaves["h0"], number) == 0

    assert not [pid for pid in pids if alive(pid)]
    assert wait_until_none(cluster.directory / "hosts") == {}
    log = cluster.log_of("h0")
    assert "Traceback" not in log
    assert "did not acknowledge" not in log
    assert f"stopping 4 processes ({number.name})" in log
    assert "slave of h0 ended; 4 processes were stopped" in log
    view = cluster.wait_until(
        "all queued", lambda v: all(row.state == "queued" for row in v.processes)
    )
    assert [row.name for row in view.processes] == ["p0", "p1", "p2", "p3"]
    assert [row.state for row in view.hosts] == ["left"]
    cluster.add(host("h0"))
    assert cluster.wait("p3", "running").host == "h0"


@pytest.mark.parametrize("after", [0.0, 1.3])
def test_a_slave_that_is_stopped_after_its_master_loses_no_process(make_cluster, after) -> None:
    """Processes of a slave that is stopped after its master are queued when both are back.

    The slave may notice the silence of the master while it stops.
    """
    cluster = make_cluster(host("h0"))
    cluster.submit(service("p"), service("q", restart=RestartPolicy("on-failure", delay=0.1)))
    before = {name: cluster.wait(name, "running").number for name in ("p", "q")}
    assert end(cluster.master, signal.SIGINT) == 0
    time.sleep(after)  # the instant of the stop is under test
    assert end(cluster.slaves["h0"], signal.SIGINT) == 0
    assert wait_until_none(cluster.directory / "hosts") == {}
    stopping = cluster.log_of("h0").partition("stopping 2 processes")[2]
    assert "slave of h0 ended; 2 processes were stopped" in stopping
    assert "keep running" not in stopping

    cluster.reconnect()
    cluster.start_master()
    cluster.add(host("h0"))
    for name, number in before.items():
        cluster.wait_until(
            f"{name} runs again", lambda v, name=name, number=number: any(
                row.name == name and row.state == "running" and row.number > number
                for row in v.processes
            ),
        )  # fmt: skip
    assert not cluster.events("failed")


@pytest.mark.parametrize("number", STOPS)
def test_a_master_that_is_stopped_touches_no_process(make_cluster, number) -> None:
    """A stopped master exits with 0, without a traceback; the next one has the same processes."""
    cluster = make_cluster(host("h0"))
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")

    assert end(cluster.master, number) == 0
    log = cluster.log_of("master")
    assert "Traceback" not in log
    assert f"ended ({number.name}); 1 process keeps running; start the master again" in log
    assert alive(before.pid)

    cluster.reconnect()
    cluster.start_master()
    after = cluster.wait("p", "running")
    assert (after.pid, after.number, after.host) == (before.pid, before.number, before.host)


def test_parts_that_are_stopped_at_once_say_what_becomes_of_the_processes(make_cluster) -> None:
    """Neither log claims that processes keep running; a second signal lists the remaining ones.

    The slave can only handle the second signal after it has begun to stop.
    """
    cluster = make_cluster(host("h0"))
    deaf = "trap '' INT TERM; while :; do sleep 0.1; done"
    cluster.submit(service("deaf", "sh", "-c", deaf, stop=StopPolicy(3.0, 3.0)))
    cluster.wait("deaf", "running")
    slave = cluster.slaves["h0"]

    slave.process.send_signal(signal.SIGINT)
    wait_until(lambda: "h0 leaves" in cluster.log_of("master"), "the master knows")
    assert end(cluster.master, signal.SIGINT) == 0
    assert end(slave, signal.SIGINT) == 0

    ended = cluster.log_of("master").rpartition("master ")[2]
    assert "ended (SIGINT); 1 process is still being stopped by the slave of h0" in ended
    log = cluster.log_of("h0")
    assert "stopping 1 process (SIGINT); processes that run after 6 s are killed" in log
    assert "still stopping deaf#1; processes that run after " in log
    assert "slave of h0 ended; 1 process was stopped" in log
    assert "running" not in log.partition("stopping 1 process")[2]
    assert wait_until_none(cluster.directory / "hosts") == {}


def test_keep_leaves_the_processes_running(make_cluster) -> None:
    """With `on_stop: keep` processes outlive their slave, and the next slave re-adopts them."""
    cluster = make_cluster(host("h0", on_stop="keep"))
    go = cluster.directory / "go"
    script = f"while [ ! -e {go} ]; do sleep 0.05; done; exit 3"
    cluster.submit(service("p"), job("short", "sh", "-c", script))
    before = cluster.wait("p", "running")
    cluster.wait("short", "running")

    assert end(cluster.slaves["h0"], signal.SIGINT) == 0
    assert alive(before.pid)
    log = cluster.log_of("h0")
    assert "slave of h0 ended (SIGINT); 2 processes keep running (supervisor pid " in log
    assert "`rosrm slave --stop-all`" in log
    view = cluster.client.list(hosts=True, processes=True)
    assert [row.state for row in view.hosts] == ["detached"]
    assert {row.state for row in view.processes} == {"unreachable"}
    go.touch()  # it ends while there is no slave

    cluster.start_slave(host("h0"))
    after = cluster.wait("p", "running")
    assert after.pid == before.pid
    row = cluster.ended("short")
    assert (row.state, row.exit_code) == ("failed", 3)
    assert "1 process still runs, 1 has ended" in cluster.log_of("h0")


def test_a_slave_that_keeps_nothing_leaves(make_cluster) -> None:
    """With `on_stop: keep` and no process, host and supervisor leave at once."""
    cluster = make_cluster(host("h0", on_stop="keep"))
    assert cluster.run(job("p", "true"))[0].state == "finished"
    assert end(cluster.slaves["h0"], signal.SIGTERM) == 0
    assert "slave of h0 ended; no processes were stopped" in cluster.log_of("h0")
    assert wait_until_none(cluster.directory / "hosts") == {}
    assert [row.state for row in cluster.client.list(hosts=True).hosts] == ["left"]


@pytest.mark.parametrize("role", ["master", "slave"])
def test_interrupted_while_it_starts(make_cluster, role) -> None:
    """Ctrl-C at any instant of the start gives no traceback and leaves nothing."""
    cluster = make_cluster()
    if role == "master":
        cluster.close()
    for delay in (0.0, 0.02, 0.05, 0.1, 0.15, 0.3, 0.5, 0.8, 1.2):
        part = cluster.start_master() if role == "master" else cluster.start_slave(host("h0"))
        time.sleep(delay)  # the instants in between are under test
        code = end(part, signal.SIGINT)
        assert code in (0, -signal.SIGINT), cluster.log_of(part.name)
        assert "Traceback" not in cluster.log_of(part.name)
        left = wait_until_none(cluster.directory / "hosts")
        assert not left, f"after {delay} s: {left}"
    if role == "slave":
        del cluster.slaves["h0"]


# --- second masters and slaves ----------------------------------------------------------------


def test_a_second_master_is_refused_naming_the_first(make_cluster) -> None:
    """A second master is refused on the same state directory, and on the same domain."""
    cluster = make_cluster(host("h0"))
    first = cluster.master
    same = cluster.start_master()
    assert same.process.wait(PATIENCE) == 1
    cluster.master = first
    said = cluster.log_of("master")
    assert f"a master runs already on {cluster.directory / 'master'}" in said
    assert f"pid {first.process.pid}" in said

    other = replace(cluster.cluster, name="rival", ros=cluster.ros, state=cluster.directory / "m2")
    second = cluster._start("master2", "rosrm.master", other.to_json())
    assert second.process.wait(PATIENCE) == 1
    said = cluster.log_of("master2")
    assert "a master runs already" in said
    assert f"pid {first.process.pid}" in said
    assert "Traceback" not in said
    assert cluster.run(job("undisturbed", "true"))[0].state == "finished"


def test_of_two_masters_at_once_one_stays(make_cluster) -> None:
    """Two masters that start at once cannot see each other; one ends and names the other."""
    cluster = make_cluster()
    cluster.close()
    domain_settings = [
        replace(
            cluster.cluster, name=f"twin{n}", ros=cluster.ros, state=cluster.directory / f"twin{n}"
        )
        for n in range(2)
    ]
    parts = [cluster._start(one.name, "rosrm.master", one.to_json()) for one in domain_settings]
    try:
        wait_until(lambda: any(p.process.poll() is not None for p in parts), "one has given way")
        ended = next(part for part in parts if part.process.poll() is not None)
        stays = next(part for part in parts if part is not ended)
        assert ended.process.returncode == 1
        assert f"pid {stays.process.pid}" in cluster.log_of(ended.name)
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline:
            assert stays.process.poll() is None, cluster.log_of(stays.name)
            time.sleep(0.05)
    finally:
        for part in parts:
            part.end(signal.SIGINT)
            part.process.wait(PATIENCE)


def test_a_second_slave_of_a_name_is_refused(make_cluster) -> None:
    """A second slave is refused by its state directory at once, or later by the master."""
    cluster = make_cluster(host("h0"), liveness=STEADY)
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    first = cluster.slaves["h0"]

    same = cluster.start_slave(host("h0"))
    assert same.process.wait(PATIENCE) == 1
    cluster.slaves["h0"] = first
    said = cluster.log_of("h0")
    assert f"a slave runs already on {cluster.directory / 'hosts' / 'h0'}" in said
    assert f"pid {first.process.pid}" in said

    state = cluster.directory / "hosts" / "impostor"
    settings = replace(host("h0"), ros=cluster.ros, state=state)
    second = cluster._start("impostor", "rosrm.slave", settings.to_json())
    assert second.process.wait(PATIENCE) == 1
    said = cluster.log_of("impostor")
    assert "a live slave has the name 'h0' already" in said
    assert f"pid {first.process.pid}" in said
    assert "Traceback" not in said
    wait_until(lambda: not pids_of(state), "no supervisor of the impostor")
    assert cluster.process("p").pid == before.pid
    assert first.process.poll() is None


def test_a_state_directory_that_cannot_be_used_is_said(make_cluster, tmp_path) -> None:
    """The error has the path and no traceback."""
    cluster = make_cluster()
    (tmp_path / "file").write_text("")
    state = tmp_path / "file" / "state"
    for module, settings in (
        ("rosrm.master", replace(cluster.cluster, ros=cluster.ros, state=state)),
        ("rosrm.slave", replace(host("h9"), ros=cluster.ros, state=state)),
    ):
        part = cluster._start("unusable", module, settings.to_json())
        assert part.process.wait(PATIENCE) == 2
    said = cluster.log_of("unusable")
    assert said.count(f"the state directory {state} cannot be used") == 2
    assert "Traceback" not in said


# --- kills ------------------------------------------------------------------------------------


def test_a_master_that_is_killed(make_cluster) -> None:
    """The next master keeps pids and the order of the queue; nothing is lost or started twice."""
    cluster = make_cluster(host("h0", max_processes=3), host("h1", max_processes=3))
    cluster.submit(*(service(f"s{n}") for n in range(6)))
    for n in range(6):
        cluster.wait(f"s{n}", "running")
    before = {row.name: row for row in cluster.client.list(processes=True).processes}
    cluster.submit(*(job(f"q{n}", "true") for n in range(5)), job("first", "true", priority=3))
    epoch = cluster.events("master_started")[-1].message

    end(cluster.master, signal.SIGKILL)
    # One process ends without a master.
    os.kill(before["s5"].pid, signal.SIGKILL)
    cluster.reconnect()
    cluster.start_master()
    for n in range(5):
        row = cluster.wait(f"s{n}", "running")
        assert (row.pid, row.number, row.host) == (
            before[row.name].pid, before[row.name].number, before[row.name].host,
        )  # fmt: skip
    assert cluster.ended("s5").state == "failed"
    for name in ("first", "q0", "q1", "q2", "q3", "q4"):
        assert cluster.ended(name).state == "finished"
    assert cluster.events("master_started")[-1].message != epoch
    order = [e.process for e in cluster.events("assigned") if not e.process.startswith("s")]
    assert order == ["first", "q0", "q1", "q2", "q3", "q4"]
    assert all(cluster.kinds(f"s{n}").count("assigned") == 1 for n in range(6))


def test_a_master_that_is_killed_again_and_again(make_cluster) -> None:
    """Answered requests are executed exactly once, at whatever instant the master is killed."""
    cluster = make_cluster(host("h0", max_processes=4), host("h1", max_processes=4))
    folder = cluster.directory / "ran"
    folder.mkdir()
    answered = []
    for round_number in range(4):
        specs = [
            job(f"r{round_number}-{n:02}", "sh", "-c", f"echo x >> {folder}/r{round_number}-{n:02}")
            for n in range(25)
        ]
        cluster.submit(*specs)
        answered += [spec.name for spec in specs]
        time.sleep(0.02 * round_number)  # another instant each time
        end(cluster.master, signal.SIGKILL)
        cluster.reconnect()
        cluster.start_master()
    for name in answered:
        assert cluster.ended(name, timeout=60.0).state == "finished", name
    runs = {path.name: path.read_text().count("x") for path in folder.iterdir()}
    assert runs == dict.fromkeys(answered, 1)


def test_a_slave_that_is_killed(make_cluster) -> None:
    """The next slave finds the same pids, reports exits since, with codes, and takes new work."""
    cluster = make_cluster(host("h0"))
    go = cluster.directory / "go"
    script = f"while [ ! -e {go} ]; do sleep 0.05; done; exit 5"
    cluster.submit(service("stays"), job("ends", "sh", "-c", script))
    before = cluster.wait("stays", "running")
    cluster.wait("ends", "running")

    end(cluster.slaves["h0"], signal.SIGKILL)
    assert alive(before.pid)
    go.touch()
    cluster.start_slave(host("h0"))
    row = cluster.ended("ends")
    assert (row.state, row.exit_code) == ("failed", 5)
    after = cluster.wait("stays", "running")
    assert (after.pid, after.number) == (before.pid, before.number)
    assert cluster.run(job("more", "true"))[0].state == "finished"
    cluster.cancel("stays")
    assert not alive(before.pid)


def test_a_supervisor_that_is_killed(make_cluster) -> None:
    """The slave starts another supervisor: same pids, exits are reported, new work runs."""
    cluster = make_cluster(host("h0"))
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    lock = cluster.directory / "hosts" / "h0" / "supervisor" / "supervisor.lock"
    supervisor = int(lock.read_text())

    os.kill(supervisor, signal.SIGKILL)
    wait_gone(supervisor)
    wait_until(lambda: lock.read_text() not in ("", str(supervisor)), "another supervisor")

    assert cluster.run(job("more", "true"))[0].state == "finished"
    assert cluster.process("p").pid == before.pid
    assert cluster.process("p").state == "running"
    os.kill(before.pid, signal.SIGKILL)
    assert cluster.ended("p").state == "failed"
    assert cluster.slaves["h0"].process.poll() is None


def test_both_killed_at_once(make_cluster) -> None:
    """Processes keep running while master and slave are killed and restarted."""
    cluster = make_cluster(host("h0"))
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    for part in cluster.parts():
        part.process.kill()
        part.process.wait(PATIENCE)
    cluster.reconnect()
    cluster.start_slave(host("h0"))
    cluster.start_master()
    after = cluster.wait("p", "running")
    assert (after.pid, after.number) == (before.pid, before.number)


def test_a_host_that_loses_its_power_starts_its_services_again(make_cluster) -> None:
    """After a power cut of host, supervisor and process, the restart policy starts the service."""
    cluster = make_cluster(host("h0"), host("h1"))
    cluster.submit(service("p", restart=RestartPolicy("on-failure", delay=0.1)))
    before = cluster.wait("p", "running")
    slave = cluster.slaves[before.host]
    supervisor = pids_of(cluster.directory / "hosts" / before.host)
    for pid in {slave.process.pid, *supervisor, before.pid}:
        os.kill(pid, signal.SIGSTOP)  # none of them notices the end of another
    for pid in {slave.process.pid, *supervisor, before.pid}:
        os.kill(pid, signal.SIGKILL)
    slave.process.wait(PATIENCE)
    wait_gone(before.pid)
    cluster.start_slave(host(before.host))
    cluster.wait_until(
        "p runs again", lambda v: any(
            row.state == "running" and row.pid != before.pid for row in v.processes
        ),
    )  # fmt: skip
    after = cluster.process("p")
    assert (after.host, after.number) == (before.host, before.number)


#: A master without the records that hosts have seen assigns no work for one lease.
SHORTLY = LivenessSettings(lease=3.0)


def test_a_lost_journal(make_cluster) -> None:
    """A master whose damaged journal was moved away, as its error advises, starts empty.

    Processes of the old journal are stopped as unknown, and the same slaves take new work under the
    same names.
    """
    cluster = make_cluster(host("h0"), liveness=SHORTLY)
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    end(cluster.master, signal.SIGKILL)
    journal = cluster.directory / "master" / "journal.sqlite"
    journal.write_bytes(b"garbage" * 1000)
    for name in ("journal.sqlite-wal", "journal.sqlite-shm"):
        (journal.parent / name).unlink(missing_ok=True)

    refused = cluster.start_master()
    assert refused.process.wait(PATIENCE) == 1
    assert "move it away" in cluster.log_of("master")

    journal.rename(journal.with_name("old"))
    cluster.reconnect()
    cluster.start_master()
    # The host registers before its open request for work is repeated.
    cluster.wait_for_hosts(timeout=20.0)
    wait_gone(before.pid)
    for number in range(3):
        assert cluster.run(job(f"new{number}", "true"))[0].state == "finished"
    cluster.submit(service("p"))
    assert cluster.wait("p", "running").pid != before.pid


@pytest.mark.parametrize("epoch", [1, 2])
def test_a_lost_journal_of_a_master_that_is_back_at_once(make_cluster, epoch) -> None:
    """The slave sees no silence, and the same or an older epoch: it registers again."""
    cluster = make_cluster(host("h0"), liveness=SHORTLY)
    for _ in range(1, epoch):
        end(cluster.master, signal.SIGKILL)
        cluster.reconnect()
        cluster.start_master()
        cluster.wait_for_hosts()
    cluster.submit(service("p"))
    before = cluster.wait("p", "running")
    end(cluster.master, signal.SIGKILL)
    for file in (cluster.directory / "master").glob("journal.sqlite*"):
        file.unlink()
    cluster.reconnect()
    cluster.start_master()
    cluster.wait_for_hosts(timeout=20.0)
    assert "epoch 1" in cluster.events("master_started")[-1].message
    wait_gone(before.pid)
    assert cluster.run(job("new", "true"))[0].state == "finished"


# --- the shell --------------------------------------------------------------------------------


@pytest.fixture
def by_hand(make_cluster):
    """Return a cluster without hosts, the state directory of a host t, and its slave's command."""
    cluster = make_cluster()
    state = cluster.directory / "hosts" / "t"
    config = cluster.directory / "host.yaml"
    config.write_text(
        f"host: t\nscope: slice\nbudget: {{memory: 1GiB, cpu: 4}}\nstate: {state}\n"
        "probes: {memory: {}, cpu: {}}\n"
        f"ros: {{domain: {cluster.domain}}}\n"
    )
    return cluster, state, [sys.executable, "-m", "rosrm.cli", "slave", "--config", str(config)]


@pytest.fixture
def kept(by_hand):
    """Return a cluster, two processes kept by a stopped slave, and the `--stop-all` command."""
    cluster, _, command = by_hand
    config = Path(command[-1])
    config.write_text(config.read_text() + "on_stop: keep\n")
    with (cluster.directory / "kept.log").open("wb") as sink, subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink
    ) as slave:  # fmt: skip
        cluster.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
        cluster.submit(service("p"), service("q"))
        rows = [cluster.wait(name, "running") for name in ("p", "q")]
        slave.terminate()
        assert slave.wait(PATIENCE) == 0
    return cluster, rows, [*command, "--stop-all"]


def stop_all(command) -> str:
    """Run `--stop-all`, and return its output."""
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "Traceback" not in done.stdout
    return done.stdout


def test_stop_all_ends_what_a_slave_has_left_and_reports_it(kept) -> None:
    """`--stop-all` completes a pending cancellation; other processes are queued again."""
    cluster, rows, command = kept
    assert "being cancelled: waits for t, whose slave was stopped" in cluster.client.cancel(["p"])
    assert "whose slave was stopped" in cluster.process("p").reason
    assert "supervisor of t ended; 2 processes were stopped" in stop_all(command)
    assert not [row.pid for row in rows if alive(row.pid)]
    assert cluster.ended("p").state == "cancelled"
    cluster.wait("q", "queued")
    assert [row.state for row in cluster.client.list(hosts=True).hosts] == ["left"]
    assert "no processes were stopped" in stop_all(command)


def test_stop_all_without_a_master_says_what_follows(kept) -> None:
    """The processes end without a master, which learns of this from the next slave."""
    cluster, rows, command = kept
    assert end(cluster.master, signal.SIGTERM) == 0
    said = stop_all(command)
    assert "2 processes were stopped" in said
    assert "the master was not reached within 5 s and does not know of these ends" in said
    assert said.count("looking for a master") == 1
    assert not [row.pid for row in rows if alive(row.pid)]


def test_stop_all_is_refused_while_the_slave_runs(by_hand) -> None:
    """`--stop-all` is refused while the slave runs, because its end stops the processes."""
    cluster, _, command = by_hand
    with (cluster.directory / "slave.log").open("wb") as sink, subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink
    ) as slave:  # fmt: skip
        cluster.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
        refused = subprocess.run(
            [*command, "--stop-all"], capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        slave.terminate()
        assert slave.wait(PATIENCE) == 0
    assert refused.returncode != 0
    assert "Stop it first" in refused.stderr


def test_ctrl_c_in_a_terminal(by_hand) -> None:
    """Ctrl-C interrupts the whole process group, and the processes end with their slave."""
    cluster, state, command = by_hand
    log = cluster.directory / "terminal.log"
    with log.open("wb") as sink, subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, start_new_session=True,
    ) as slave:  # fmt: skip
        cluster.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
        cluster.submit(service("p"))
        pid = cluster.wait("p", "running").pid
        os.killpg(slave.pid, signal.SIGINT)
        assert slave.wait(PATIENCE) == 0
    assert not alive(pid)
    assert "Traceback" not in Path(log).read_text()
    assert wait_until_none(state) == {}


def test_a_terminal_that_is_closed(by_hand) -> None:
    """After SIGHUP the slave cannot write to its terminal, and still stops its processes."""
    cluster, state, command = by_hand
    terminal, its_end = pty.openpty()
    slave = subprocess.Popen(
        ["setsid", "--ctty", *command], stdin=its_end, stdout=its_end, stderr=its_end
    )
    os.close(its_end)
    try:
        cluster.wait_until("host t", lambda v: any(row.accepting for row in v.hosts))
        cluster.submit(service("p"))
        pid = cluster.wait("p", "running").pid
    finally:
        os.close(terminal)
        code = slave.wait(PATIENCE)
    assert code == 0
    assert not alive(pid)
    assert wait_until_none(state) == {}
