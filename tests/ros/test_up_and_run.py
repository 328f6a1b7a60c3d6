"""`rosrm up` and `rosrm run` with real processes, from start to end."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil
import pytest

from rosrm.testing.local_cluster import claim_domain
from tests.hung_files import hung_files
from tests.ros.clusters import alive, host, pids_of, wait_until_none
from tests.ros.test_command_line import Terminal, read_until
from tests.waiting import PATIENCE, wait_until

WORK = """
processes:
  - name: "sleeper_{i}"
    foreach: {i: "range(1, 3)"}
    command: sleep 1000
    labels: {required: {host: "host-{i}"}}
"""


APPLICATION = """
app: nav
processes:
  - name: greeter
    command: [sh, -c, "cat {artifacts}/greeting.txt; exec sleep 1000"]
    artifacts: {greeting.txt: ./greeting.txt}
"""


@contextmanager
def started(terminal: Terminal, *words: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """Start `rosrm up`; yield it and its output once both sleepers are ready."""
    work = terminal.file("work.yaml", WORK)
    with terminal.start("up", "--hosts", "2", *words, work, start_new_session=True) as process:
        try:
            said = ""
            for ready in ("sleeper_1 is running", "sleeper_2 is running"):
                if ready not in said:
                    said += read_until(process.stdout.fileno(), ready)
                assert ready in said, said + process.stderr.read()
            yield process, said
        finally:
            process.kill()  # without effect on one that has ended


@pytest.fixture
def terminal(tmp_path) -> Iterator[Terminal]:
    """A terminal with its own domain and its own folder of temporary files."""
    domain, claim = claim_domain()
    with claim:
        terminal = Terminal(domain, tmp_path)
        terminal.environment["TMPDIR"] = str(tmp_path / "temporary")
        (tmp_path / "temporary").mkdir()
        yield terminal
        assert wait_until_none(tmp_path) == {}


def test_ctrl_c_ends_all_that_up_has_started(terminal, tmp_path) -> None:
    """Another process sees hosts and work; after Ctrl-C neither a process nor a file is left.

    The parts join ROS with `rosrm up`'s own default, LOCALHOST, and the other process with ROS's.
    """
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTDDS_BUILTIN_TRANSPORTS"):
        terminal.environment.pop(name, None)
    with started(terminal) as (process, said):
        assert "ready: host-1 and host-2, each with " in said
        assert "discovery LOCALHOST" in said
        rows = terminal.json("ps")
        assert {row["name"]: (row["host"], row["state"]) for row in rows} == {
            "sleeper_1": ("host-1", "running"), "sleeper_2": ("host-2", "running"),
        }  # fmt: skip
        parts = psutil.Process(process.pid).children(recursive=True)
        assert len(parts) == 4  # master, two slaves, cleaner
        refused = terminal.run("up", code=1)
        assert "a master runs already on domain" in refused
        os.killpg(process.pid, signal.SIGINT)
        rest, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors) == (0, "")
    assert "ended; nothing runs any more" in rest
    assert not any(alive(pid) for pid in [row["pid"] for row in rows] + [p.pid for p in parts])
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_file_with_an_application_is_applied(terminal) -> None:
    """Its artifacts are sent before, and the progress is shown."""
    terminal.file("greeting.txt", "hello")
    work = terminal.file("nav.yaml", APPLICATION)
    with terminal.start("up", work, start_new_session=True) as process:
        try:
            said = read_until(process.stdout.fileno(), "nav is at version 1 with 1 process")
            assert "nav is at version 1 with 1 process" in said, said + process.stderr.read()
            assert "hello" in terminal.run("logs", "greeter")
            os.killpg(process.pid, signal.SIGINT)
            process.communicate(timeout=PATIENCE)
        finally:
            process.kill()  # without effect on one that has ended


def test_nothing_is_left_after_a_kill(terminal, tmp_path) -> None:
    """After SIGKILL of `rosrm up` and of a slave, all else ends, and the files are removed."""
    with started(terminal) as (process, _):
        slaves = [one for one in psutil.Process(process.pid).children() if _is_slave(one)]
        os.kill(slaves[0].pid, signal.SIGKILL)
        os.kill(process.pid, signal.SIGKILL)
        folder = tmp_path / "temporary"
        wait_until(lambda: not pids_of(folder), "no process", seen=lambda: pids_of(folder))
        wait_until(lambda: not list(folder.iterdir()), "no file")


def _is_slave(process: psutil.Process) -> bool:
    return process.name() == "rosrm-slave"


def test_a_part_that_dies_ends_the_rest(terminal, tmp_path) -> None:
    """The error names the part and its log, which stays; the processes have ended."""
    state = tmp_path / "state"
    with started(terminal, "--state", str(state)) as (process, _):
        rows = terminal.json("ps")
        (slave, _) = [one for one in psutil.Process(process.pid).children() if _is_slave(one)]
        slave.kill()
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "the slave of host-" in errors
    assert "has ended (killed by SIGKILL). Its log is " in errors
    assert "registered with master" in errors
    assert not any(alive(row["pid"]) for row in rows)
    assert Path(state, "host-1.log").exists()


def test_a_job_of_the_command_line(make_cluster, tmp_path) -> None:
    """`rosrm run` prints the output and exits with the job's code; Ctrl-C cancels the job."""
    cluster = make_cluster(host("h0"))
    terminal = Terminal(cluster.domain, tmp_path)
    terminal.run("status")  # a master can be found in time now
    done = terminal.finish(
        terminal.start("run", "--needs", "memory=5MB", "--", "sh", "-c", "echo out; exit 3")
    )
    assert (done.returncode, done.stdout, done.stderr) == (3, "out\n", "")

    waits = ("run", "--name", "big", "--needs", "memory=1TB", "--", "true")
    with terminal.start(*waits, start_new_session=True) as process:
        said = read_until(process.stderr.fileno(), "run it again with other `--needs` or `--on`")
        assert "big waits for a host: " in said
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 128 + signal.SIGTERM
    assert cluster.ended("big").state == "cancelled"

    line = "trap 'echo interrupted; exit 0' INT; echo begun; while true; do sleep 0.1; done"
    words = ("run", "--name", "long", "--", "sh", "-c", line)
    with terminal.start(*words, start_new_session=True) as process:
        said = read_until(process.stdout.fileno(), "begun")
        os.killpg(process.pid, signal.SIGINT)
        rest, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, said + rest) == (130, "begun\ninterrupted\n")
    assert "cancelling long; Ctrl-C again leaves at once" in errors
    assert cluster.ended("long").state == "cancelled"


def test_a_terminal_that_lacks_a_character_ends_nothing(terminal) -> None:
    """Each command shows the number of a character that the terminal lacks, and continues."""
    terminal.environment["PYTHONIOENCODING"] = "iso8859-1"
    work = terminal.file("arrow.yaml", "processes: [{name: odd, kind: job, command: [no→such]}]")
    with terminal.start("up", work, start_new_session=True) as process:
        try:
            said = read_until(process.stdout.fileno(), "odd failed")
            assert r"no\u2192such" in said, said + process.stderr.read()
            for command in ("ps --all", "events", "explain odd", "top -n 1"):
                assert r"no\u2192such" in terminal.run(*command.split())
            terminal.run("status")
            assert process.poll() is None
            os.killpg(process.pid, signal.SIGINT)
            process.communicate(timeout=PATIENCE)
            assert process.returncode == 0
        finally:
            process.kill()  # without effect on one that has ended


def test_processes_without_a_supervisor_are_ended(terminal) -> None:
    """`rosrm up` ends processes whose supervisor was killed before it reports that none runs."""
    with started(terminal) as (process, _):
        pids = [row["pid"] for row in terminal.json("ps")]
        parts = psutil.Process(process.pid).children(recursive=True)
        os.kill(process.pid, signal.SIGSTOP)
        for slave in [one for one in parts if _is_slave(one)]:
            supervisor = _supervisor_of(slave)
            for pid in (slave.pid, supervisor):
                os.kill(pid, signal.SIGKILL)
        os.kill(process.pid, signal.SIGINT)
        os.kill(process.pid, signal.SIGCONT)
        process.communicate(timeout=2 * PATIENCE)
    assert not any(map(alive, pids))


def _supervisor_of(slave: psutil.Process) -> int:
    (state,) = {Path(one.path).parent for one in slave.open_files() if one.path.endswith(".lock")}
    return int((state / "supervisor" / "supervisor.lock").read_text())


def test_ctrl_c_ends_while_a_file_system_hangs(terminal, tmp_path) -> None:
    """One process runs from it, another one waits for it, and its parameters are read there."""
    files = {"program": b"#!/bin/sh\\nexec sleep 1000\\n", "parameters.yaml": b"a: 1\\n"}
    with hung_files(tmp_path / "hung", files) as hung:
        text = f"""
processes:
  - {{name: waits, command: [sleep, "1000"], working_directory: {hung.place}}}
  - {{name: reads, command: [sleep, "1000"], ros: true, parameters: [{hung.place}/parameters.yaml]}}
  - {{name: works, command: sleep 1000}}
"""
        hung.hang()
        work = terminal.file("work.yaml", text)
        with terminal.start("up", work, start_new_session=True) as process:
            try:
                said = read_until(process.stdout.fileno(), "works is running")
                wait_until(lambda: hung.unanswered, "a call that waits")
                os.killpg(process.pid, signal.SIGINT)
                rest, errors = process.communicate(timeout=2 * PATIENCE)
            finally:
                process.kill()
    assert "ended; nothing runs any more" in rest, said + rest + errors


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_a_signal_that_the_starter_ignores_ends_nothing(terminal, number) -> None:
    """`nohup`, and a shell that starts a program with `&` in a script, ignore such signals."""
    former = signal.signal(number, signal.SIG_IGN)
    try:
        starts = started(terminal)
        process, _ = starts.__enter__()
    finally:
        signal.signal(number, former)
    with ExitStack() as closing:
        closing.push(starts)
        os.killpg(process.pid, number)
        assert {row["state"] for row in terminal.json("ps")} == {"running"}
        process.send_signal(signal.SIGTERM)
        rest, _ = process.communicate(timeout=PATIENCE)
    assert "ended; nothing runs any more" in rest
