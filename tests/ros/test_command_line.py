"""Every command end to end: the `rosrm` program against a real cluster."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import getpass
import json
import os
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest

from rosrm.cli.ros2_verb import complete
from rosrm.client.start_traces import BESIDE, STAMPS
from rosrm.testing.local_cluster import claim_domain
from tests.ros.clusters import alive, host, wait_until_none
from tests.waiting import PATIENCE, quickest, wait_gone, wait_until

WORK = """
processes:
  - name: talker
    command: [sh, -c, "echo hello from talker; sleep 1000"]
    needs: {{memory: 10MB}}
    migration: relaunch
    stop: {{interrupt_grace: 0.5s, terminate_grace: 0.5s}}
  - name: counter
    kind: job
    command: [sh, -c, "for n in 1 2 3; do echo $n; done"]
  - name: loser
    kind: job
    command: [sh, -c, "exit 4"]
"""


#: Exit code of a command that found no master.
NO_MASTER = 3


class Terminal:
    """The `rosrm` command in the domain of a cluster."""

    def __init__(self, domain: int, directory: Path):
        self.directory = directory
        self.environment = {
            **os.environ, "ROS_DOMAIN_ID": str(domain), "COLUMNS": "200", "NO_COLOR": "1",
            "PYTHONUNBUFFERED": "1", "TERM": "xterm",
        }  # fmt: skip

    def start(self, *words: str, **options) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-m", "rosrm.cli", *words], env=self.environment, text=True,
            stderr=subprocess.PIPE,
            **{"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, **options},
        )  # fmt: skip

    def run(self, *words: str, code: int = 0) -> str:
        """Run a command; return its standard output, or its standard error if it is to fail.

        A command looks for the master for less than 3 s, which may be too short on a busy machine.
        A command that found no master, and so sent no request, is repeated.
        """
        deadline = time.monotonic() + PATIENCE
        run = self.finish(self.start(*words))
        while run.returncode == NO_MASTER != code and time.monotonic() < deadline:
            run = self.finish(self.start(*words))
        return self.check(run, code)

    def finish(self, run: subprocess.Popen) -> subprocess.CompletedProcess:
        """Wait for the end of a started command."""
        try:
            output, errors = run.communicate(timeout=PATIENCE)
        finally:
            run.kill()
        return subprocess.CompletedProcess(run.args, run.returncode, output, errors)

    def check(self, run: subprocess.CompletedProcess, code: int) -> str:
        """Check an ended command as `run` does, and return its output."""
        said = f"{run.args}: exit {run.returncode}\n{run.stdout}\n{run.stderr}"
        assert run.returncode == code, said
        assert "Traceback" not in said
        return run.stdout if code == 0 else run.stderr

    @contextlib.contextmanager
    def follow(self, *words: str, says: str) -> Iterator[tuple[subprocess.Popen, str]]:
        """Start a command, repeated as by `run`; yield it and its output once it prints `says`."""
        deadline = time.monotonic() + PATIENCE
        while True:
            with self.start(*words, start_new_session=True) as process:
                try:
                    said = read_until(process.stdout.fileno(), says)
                    if says in said:
                        yield process, said
                        return
                finally:
                    process.kill()
            assert process.returncode == NO_MASTER, f"it ended after {said!r}"
            assert time.monotonic() < deadline, "no master was found"

    def json(self, *words: str):
        return json.loads(self.run(*words, "--json"))

    def file(self, name: str, text: str) -> str:
        path = self.directory / name
        path.write_text(text)
        return str(path)


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), host("h1", labels={"place": "lab"}))


@pytest.fixture(scope="module")
def rosrm(cluster, tmp_path_factory) -> Terminal:
    terminal = Terminal(cluster.domain, tmp_path_factory.mktemp("t"))
    work = terminal.file("work.yaml", WORK.format())
    assert "3 processes" in terminal.run("submit", work)
    cluster.wait("talker", "running")
    cluster.wait_for_log("talker", "hello")
    cluster.ended("counter")
    cluster.ended("loser")
    return terminal


# --- listings ---------------------------------------------------------------------------------


def test_ps(rosrm, cluster) -> None:
    """`rosrm ps` prints a table, and everything as JSON."""
    table = rosrm.run("ps")
    assert "talker" in table
    assert "loser" in table
    assert "counter" not in table
    assert "counter" in rosrm.run("ps", "--all")
    rows = {row["name"]: row for row in rosrm.json("ps")}
    assert rows["talker"]["state"] == "running"
    assert rows["talker"]["pid"] == cluster.process("talker").pid
    assert (rows["loser"]["state"], rows["loser"]["exit_code"]) == ("failed", 4)
    assert rows["counter"]["state"] == "finished"
    assert rows["talker"]["exit_code"] is None
    assert "loser" in rosrm.run("ps", "--host", rows["loser"]["host"])
    where = rows["talker"]["host"]
    assert "talker" in rosrm.run("ps", "--host", where)
    assert "talker" not in rosrm.run("ps", "--host", "h1" if where == "h0" else "h0")


def test_a_command_leaves_no_file_in_the_log_directory_of_ros(rosrm, tmp_path) -> None:
    """ROS would make an empty one for each command."""
    rosrm.environment["ROS_LOG_DIR"] = str(tmp_path)
    try:
        rosrm.run("ps")
    finally:
        del rosrm.environment["ROS_LOG_DIR"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("words", "name"), [("explain t", "talker"), ("drain h", "h1")])
def test_names_complete_in_bash(rosrm, words, name) -> None:
    """The names come from the master; on a busy machine a search may find none in time."""
    line = {"_ROSRM_COMPLETE": "complete_bash", "COMP_WORDS": f"rosrm {words}", "COMP_CWORD": "2"}

    def complete() -> str:
        done = subprocess.run(
            [sys.executable, "-m", "rosrm.cli"], env={**rosrm.environment, **line},
            capture_output=True, text=True, timeout=PATIENCE, check=True,
        )  # fmt: skip
        assert done.stderr == ""
        return done.stdout

    wait_until(lambda: name in complete().split(), f"{name} as the completion of {words!r}")


def test_names_complete_behind_ros2(rosrm, monkeypatch) -> None:
    """The same names reach `ros2 rosrm`, whose completion calls the verb."""
    for name, value in rosrm.environment.items():
        monkeypatch.setenv(name, value)
    given = argparse.Namespace(words=["explain"])
    wait_until(lambda: complete("t", given) == ["talker"], "the completion of `ros2 rosrm explain`")


def test_hosts(rosrm) -> None:
    """`rosrm hosts` shows both hosts, with usage and limits."""
    table = rosrm.run("hosts")
    assert "h0" in table
    assert "memory" in table
    rows = {row["name"]: row for row in rosrm.json("hosts")}
    assert rows["h1"]["labels"] == {"place": "lab"}
    assert rows["h0"]["state"] == "up"
    memory = next(r for r in rows["h0"]["resources"] if r["name"] == "memory")
    assert 0.0 <= memory["usage"] < memory["limit"] == pytest.approx(0.8)


def test_events(rosrm) -> None:
    """`rosrm events` prints events in order, optionally of one process."""
    assert "counter" in rosrm.run("events")
    events = rosrm.json("events", "--process", "counter")
    kinds = [event["kind"] for event in events]
    assert kinds[0] == "submitted"
    assert kinds[-1] == "finished"
    assert [e["sequence"] for e in events] == sorted(e["sequence"] for e in events)
    assert len(rosrm.json("events", "--newest", "2")) == 2


def test_explain(rosrm) -> None:
    """`rosrm explain` gives the reason for the placement, with every host."""
    text = rosrm.run("explain", "talker")
    assert "h0" in text
    assert "h1" in text
    story = rosrm.json("explain", "talker")
    assert story["process"] == "talker"
    assert story["state"] == "running"


def test_plugins(rosrm) -> None:
    """`rosrm plugins` lists those of the master, of every host, and of this installation."""
    rows = rosrm.json("plugins")
    assert {"weighted", "threshold", "relaunch"} <= {row["name"] for row in rows}
    selected = [row for row in rows if row["kind"] == "scoring" and row["state"] == "selected"]
    assert [row["name"] for row in selected] == ["weighted"]
    assert {row["host"] for row in rows if row["kind"] == "probe"} >= {"h0", "h1"}
    assert "weighted" in rosrm.run("plugins")
    local = rosrm.json("plugins", "--local")
    assert {"memory", "cpu"} <= {row["name"] for row in local if row["kind"] == "probe"}


def test_logs(rosrm) -> None:
    """`rosrm logs` prints all or the end, of running and ended processes."""
    assert rosrm.run("logs", "counter") == "1\n2\n3\n"
    assert rosrm.run("logs", "counter", "--tail", "1") == "3\n"
    assert rosrm.run("logs", "counter", "--since", "1h") == "1\n2\n3\n"
    assert rosrm.run("logs", "talker") == "hello from talker\n"
    all_lines = rosrm.run("logs", "talker", "counter", "-t").splitlines()
    lines = [line for line in all_lines if " | --- started on h" not in line]
    assert len(all_lines) == len(lines) + 2
    assert sorted(line.split()[0] for line in lines) == [*["counter"] * 3, "talker"]
    written = [datetime.fromisoformat(line.split()[2]).timestamp() for line in lines]
    assert written == sorted(written)
    assert all(0.0 < time.time() - when < PATIENCE * 10 for when in written)


def test_an_unknown_name(rosrm) -> None:
    """The command exits with 1 and the name in its error."""
    assert "absent" in rosrm.run("cancel", "absent", code=1)
    assert "no such process" in rosrm.run("logs", "absent", code=1)


# --- until Ctrl-C -----------------------------------------------------------------------------


def read_until(descriptor: int, text: str) -> str:
    """Return all output until a text has come, or until the end."""
    said, deadline = "", time.monotonic() + PATIENCE
    while text not in said:
        left = max(0.0, deadline - time.monotonic())
        ready, _, _ = select.select([descriptor], [], [], left)
        assert ready, f"it did not say {text!r}: {said!r}"
        try:
            part = os.read(descriptor, 65536).decode(errors="replace")
        except OSError:  # a terminal whose other end is closed
            break
        if not part:
            break
        said += part
    return said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("logs", "-f", "talker"), "hello from talker"),
        (("events", "-f"), "counter"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else "",
)
def test_following_ends_with_ctrl_c(rosrm, words, says) -> None:
    """Ctrl-C ends the command without a traceback, with the exit code that a shell expects."""
    with rosrm.follow(*words, says=says) as (process, _):
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode in (0, 130)
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("words", "says"), [(("logs", "-f", "talker"), "hello"), (("events", "-f"), "counter")]
)
def test_following_ends_when_its_reader_has_gone(rosrm, words, says) -> None:
    """`rosrm logs -f talker | grep -m1 hello` ends, also if no further line comes."""
    with rosrm.follow(*words, says=says) as (process, _):
        process.stdout.close()
        assert process.wait(PATIENCE) == 1
        assert process.stderr.read() == ""


def test_a_line_without_an_end_is_shown_in_a_terminal(rosrm, cluster) -> None:
    """`logs -f` shows an unfinished line, such as a prompt, and later the rest of the line."""
    go = rosrm.directory / "answered"
    work = rosrm.file(
        "asks.yaml",
        'processes:\n  - name: asks\n    kind: job\n    command: [sh, -c, \'printf "ready> "; '
        f"while [ ! -e {go} ]; do sleep 0.05; done; echo gone']\n",
    )
    rosrm.run("submit", work)
    cluster.wait("asks", "running")
    screen, inside = os.openpty()
    with rosrm.start("logs", "-f", "asks", start_new_session=True, stdout=inside) as process:
        os.close(inside)
        try:
            said = read_until(screen, "ready> ")
            go.touch()
            said += read_until(screen, "gone\r\n")
            assert said == "ready> gone\r\n"
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()
            os.close(screen)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_signal_leaves_the_terminal_of_top_as_it_was(rosrm, number) -> None:
    """The terminal has echo and cursor again, for the shell that started the command."""
    rosrm.run("status")  # a master can be found in time now
    screen, inside = os.openpty()
    usual = termios.tcgetattr(inside)
    with rosrm.start("top", start_new_session=True, stdin=inside, stdout=inside) as process:
        try:
            said = read_until(screen, "q quits")
            process.send_signal(number)
            said += read_until(screen, "\x1b[?25h")
            assert "\x1b[?25l" in said
            assert process.wait(PATIENCE) == 128 + number
            assert termios.tcgetattr(inside) == usual
        finally:
            process.kill()
            os.close(inside)
            os.close(screen)


def test_top_can_be_stopped_and_continued(rosrm) -> None:
    """The shell gets its terminal on Ctrl-Z, and the keys work after `fg`."""
    rosrm.run("status")  # a master can be found in time now
    script = (
        f"set -m; {sys.executable} -m rosrm.cli top --period 60s; "
        "echo STOPPED $(stty -a | grep -o -e '-\\?echo\\b'); "
        "read; fg; echo ENDED $?"
    )
    screen, inside = os.openpty()
    with subprocess.Popen(
        ["bash", "-c", script], env=rosrm.environment, start_new_session=True,
        stdin=inside, stdout=inside, stderr=inside,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY),  # noqa: PLW1509 - no thread runs
    ) as shell:  # fmt: skip
        os.close(inside)
        try:
            read_until(screen, "q quits")
            os.write(screen, b"\x1a")
            read_until(screen, "STOPPED echo\r\n")
            os.write(screen, b"\n")  # the screen that follows is not part of the same read
            read_until(screen, "q quits")
            os.write(screen, b"m")
            read_until(screen, "q quits")
            os.write(screen, b"q")
            read_until(screen, "ENDED 0\r\n")
        finally:
            shell.kill()
            os.close(screen)


def test_a_command_in_a_removed_directory_works(rosrm, tmp_path) -> None:
    """The command works although relative search paths of its libraries lead nowhere."""
    gone = tmp_path / "gone"
    gone.mkdir()
    script = 'cd "$0"; rmdir "$0"; exec "$1" ps'
    program = str(Path(sys.executable).with_name("rosrm"))
    run = subprocess.run(
        ["sh", "-c", script, str(gone), program], env=rosrm.environment, capture_output=True,
        text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert "talker" in run.stdout
    assert run.stderr.splitlines() == [
        "rosrm: the current directory cannot be used (No such file or directory); continuing in /"
    ]


def test_top_in_a_terminal(rosrm) -> None:
    """`rosrm top` shows a live picture until Ctrl-C."""
    rosrm.run("status")  # a master can be found in time now
    screen, inside = os.openpty()
    with rosrm.start("top", "--period", "0.2", start_new_session=True, stdout=inside) as process:
        os.close(inside)
        try:
            for _ in range(2):
                assert "talker" in read_until(screen, "talker")
            process.send_signal(signal.SIGINT)
            read_until(screen, "nothing more")  # it may block until its last picture is read
            assert process.wait(PATIENCE) in (0, 130)
            assert "Traceback" not in process.stderr.read()
        finally:
            process.kill()
            os.close(screen)


def test_top_sorts_and_ends_by_a_key(rosrm) -> None:
    """Keys are not echoed, `q` ends with exit code 0, and the terminal's settings are restored."""
    rosrm.run("status")  # a master can be found in time now
    screen, inside = os.openpty()
    usual = termios.tcgetattr(inside)
    terminal = {"stdin": inside, "stdout": inside}
    with rosrm.start("top", "--period", "30s", start_new_session=True, **terminal) as process:
        try:
            assert "talker" in read_until(screen, "q quits")
            os.write(screen, b"m")  # the next picture comes at once, not after 30 s
            assert "talker" in read_until(screen, "q quits")
            os.write(screen, b"q")
            assert process.wait(PATIENCE) == 0, process.stderr.read()
            assert termios.tcgetattr(inside) == usual
        finally:
            process.kill()
            os.close(inside)
            os.close(screen)


def test_following_a_log_to_its_end(rosrm, cluster) -> None:
    """`rosrm logs -f` ends once the process has ended and all output is shown."""
    go = rosrm.directory / "go"
    work = rosrm.file(
        "slow.yaml",
        f"processes:\n  - name: slow\n    kind: job\n"
        f"    command: [sh, -c, 'echo one; while [ ! -e {go} ]; do sleep 0.05; done; echo two']\n",
    )
    rosrm.run("submit", work)
    cluster.wait("slow", "running")
    with rosrm.follow("logs", "-f", "slow", says="one\n") as (process, said):
        go.touch()
        rest, errors = process.communicate(timeout=PATIENCE)
    assert said + rest == "one\ntwo\n"
    assert process.returncode == 0, errors


# --- actions ----------------------------------------------------------------------------------


def test_a_traced_submission_shows_its_hand_overs_in_order(rosrm) -> None:
    """Each part adds its stamps: client, master, slave, supervisor, and the process itself."""
    stamp = "processes: [{name: stamp, kind: job, command: [date, +%s%N]}]"
    work = rosrm.file("stamp.work.yaml", stamp)
    (trace,) = json.loads(rosrm.run("submit", work, "--trace", "--json", "--timeout", "30s"))
    stamps = trace["stamps"]
    assert trace["process"] == "stamp"
    assert stamps.keys() == STAMPS.keys() | BESIDE.keys()
    in_order = [stamps[name] for name in STAMPS]
    assert in_order == sorted(in_order)
    assert stamps["recorded"] <= stamps["spawned"]
    assert stamps["master_received"] <= stamps["client_answered"]
    steps = [row["step_ms"] for row in trace["hand_overs"] if row["step_ms"] is not None]
    assert len(steps) == len(STAMPS) - 1
    assert sum(steps) == pytest.approx((in_order[-1] - in_order[0]) / 1e6)


def test_a_name_in_use(rosrm) -> None:
    """The submission exits with 1, and no process of the file is queued."""
    work = rosrm.file(
        "twice.yaml",
        "processes:\n  - {name: other, command: ['true']}\n  - {name: talker, command: ['true']}\n",
    )
    assert "talker" in rosrm.run("submit", work, code=1)
    assert "other" not in {row["name"] for row in rosrm.json("ps")}


def test_migrate_restart_cordon_drain_cancel(rosrm, cluster) -> None:
    """Each command prints its effect; with --wait it returns after completion."""
    before = cluster.process("talker")
    other = "h1" if before.host == "h0" else "h0"
    said = rosrm.run("migrate", "talker", "--to", other, "--wait", "--timeout", "60s")
    assert f"talker moved from {before.host} to {other}" in said
    here = cluster.process("talker")
    assert (here.host, here.state) == (other, "running")
    rosrm.run("restart", "talker", "--wait", "--timeout", "60s")
    wait_gone(here.pid)
    assert cluster.process("talker").pid not in (0, here.pid)

    assert "cordoned" in rosrm.run("cordon", before.host)
    assert cluster.host(before.host).cordoned
    assert "uncordoned" in rosrm.run("uncordon", before.host)
    assert not cluster.host(before.host).cordoned
    assert "talker" in rosrm.run("drain", other)
    cluster.wait("talker", "running", host=before.host)
    assert f"talker moves from {other}" in rosrm.run("events", "--host", other)
    rosrm.run("uncordon", other)
    last = cluster.process("talker")
    rosrm.run("cancel", "talker", "--wait", "--timeout", "60s")
    assert cluster.process("talker").state == "cancelled"
    assert not alive(last.pid)
    told = rosrm.run("events", "--process", "talker", "-n", "1000")
    assert f"(by user:{getpass.getuser()})" in told
    rosrm.run("prune", "talker")
    assert "talker" not in rosrm.run("ps", "--all")


# --- without a master -------------------------------------------------------------------------


def test_no_master(tmp_path) -> None:
    """Without a master a command exits with 3 in time, and names domain and RMW."""
    domain, claim = claim_domain()
    terminal = Terminal(domain, tmp_path)
    work = terminal.file("work.yaml", "processes:\n  - {name: x, command: ['true']}\n")
    with claim:
        quickest(lambda: terminal.run("ps", code=NO_MASTER), 4.5)  # 3 s are promised
        said = terminal.run("submit", work, code=NO_MASTER)
    assert f"domain {domain}" in said
    assert "rmw_fastrtps_cpp" in said


# --- master and slave -------------------------------------------------------------------------


def test_a_cluster_by_hand(tmp_path) -> None:
    """`rosrm master`, `rosrm slave` and `rosrm submit` work; Ctrl-C ends both parts with code 0.

    Ctrl-C interrupts the whole process group, and the processes end with their slave. No part uses
    shared memory, even with LOCALHOST: a killed part's port would delay commands.
    """
    with by_hand(tmp_path, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST") as (terminal, master, slave):
        work = terminal.file("work.yaml", "processes:\n  - {name: p, command: [sleep, '1000']}\n")
        terminal.run("submit", work, "--wait")
        (row,) = terminal.json("ps")
        assert (row["name"], row["host"], row["state"]) == ("p", "hand", "running")
        for part in (master, slave):
            assert "fastrtps_port" not in Path(f"/proc/{part.pid}/maps").read_text()
        for part in (slave, master):
            os.killpg(part.pid, signal.SIGINT)
            _, errors = part.communicate(timeout=PATIENCE)
            assert part.returncode == 0, errors
            assert "Traceback" not in errors
        assert not alive(row["pid"])
        assert wait_until_none(tmp_path) == {}


@contextlib.contextmanager
def by_hand(
    directory: Path, **environment: str
) -> Iterator[tuple[Terminal, subprocess.Popen, subprocess.Popen]]:
    """Yield a terminal, a master and a slave in their own domain."""
    domain, claim = claim_domain()
    terminal = Terminal(domain, directory)
    terminal.environment |= environment
    ros = f"ros: {{domain: {domain}}}\n"
    cluster = terminal.file("cluster.yaml", f"name: hand\nstate: {directory}/m\n{ros}")
    host_file = terminal.file(
        "host.yaml",
        f"host: hand\nstate: {directory}/s\nscope: slice\nbudget: {{memory: 1GiB, cpu: 4}}\n"
        f"probes: {{memory: {{}}, cpu: {{}}}}\n{ros}",
    )
    parts = []
    try:
        with claim:
            parts.append(terminal.start("master", "--config", cluster, start_new_session=True))
            parts.append(terminal.start("slave", "--config", host_file, start_new_session=True))
            yield terminal, *parts
    finally:
        for part in reversed(parts):
            with part:
                part.send_signal(signal.SIGINT)
                try:
                    part.wait(PATIENCE)
                finally:
                    part.kill()
