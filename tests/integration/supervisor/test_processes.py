"""Real processes under a real supervisor: start, run and end."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import signal
import time
from dataclasses import replace
from functools import partial

import pytest

from rosrm.core.supervisor.events import FailOrdered, StopOrdered
from rosrm.model.values import InstanceState, RestartPolicy
from rosrm.runtime import private_files, timer_slack
from rosrm.supervisor import procfs
from tests.waiting import PATIENCE, wait_gone, wait_until

IGNORES_ALL = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("deaf", flush=True)
time.sleep(1000)
"""
DAEMON = """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open("daemon.pid", "w").write(str(os.getpid()))
        time.sleep(1000)
    os._exit(0)
os.wait()
while not os.path.exists("daemon.pid"): time.sleep(0.01)
"""


def test_exit_status_usage_and_output_are_kept(host, client):
    """The final status of a short process has its exit code, times, memory; its output is kept."""
    status = host.run(client, host.order("short", "sh", "-c", "echo out; echo err >&2; exit 3"))
    assert (status.state, status.exit_code) == (InstanceState.FAILED, 3)
    assert status.message == "exit code 3"
    assert 0 < status.run_time < 10
    assert status.peak_memory > 0
    assert host.log("short").read_text() == "out\nerr\n"


@pytest.mark.parametrize("given", [True, False])
def test_a_file_that_its_working_directory_lacks_is_named_with_the_failure(
    host, client, tmp_path, given
):
    """Without the name the reason may be only "exit code 2", and rosrm chose the directory."""
    (tmp_path / "there.py").touch()
    words = ("sh", "-c", "exit 2", "./x.py", "there.py")
    order = host.order("lost", *words, working_directory=str(tmp_path) if given else None)
    status = host.run(client, replace(order, files=("./x.py", *(["there.py"] if given else []))))
    where = (
        f"its `working_directory`, '{tmp_path}'"
        if given
        else "a directory of rosrm's own, because it has no `working_directory`"
    )
    assert status.message.startswith(f"exit code 2; there was no './x.py' in {where}")


def test_a_removed_state_directory_is_the_reason_of_a_refused_start(host, client):
    """Running processes continue, and can be stopped."""
    pid = host.sleeper(client, "old")
    shutil.rmtree(host.state / "work")
    status = host.run(client, host.order("new", "true"))
    assert status.state is InstanceState.REFUSED
    assert status.message.startswith("the state directory of this host was removed under its")
    assert procfs.read_stat(pid) is not None
    client.send(StopOrdered(("old", 1)))
    host.ended(client, "old")


def test_many_short_processes_at_once_leave_the_supervisor_alive(host, client):
    """Starts and ends that arrive in one batch of events do not disturb each other."""
    names = [f"short{number}" for number in range(150)]
    client.start([host.order(name, "true") for name in names])
    running, deadline = set(names), time.monotonic() + PATIENCE
    while running and time.monotonic() < deadline:
        for status in client.receive(deadline - time.monotonic()):
            if status.state is InstanceState.EXITED:
                running.discard(status.instance.process)
    assert not running


def test_a_crash_is_reported_with_its_signal(host, client):
    """A process killed by a foreign signal has failed, and the message names the signal."""
    status = host.run(client, host.order("crash", "sh", "-c", "kill -SEGV $$"))
    assert (status.state, status.exit_signal) == (InstanceState.FAILED, signal.SIGSEGV)
    assert status.message == "killed by SIGSEGV"


def test_a_process_is_alone_in_its_session(host, client):
    """A process leads its own session, inherits only its log, and reads /dev/null."""
    code = """
import os
print(os.getsid(0) == os.getpid() == os.getpgrp(), os.readlink("/proc/self/fd/0"))
print(sorted(int(fd) for fd in os.listdir("/proc/self/fd"))[:-1], os.getcwd())
"""
    host.run(client, host.python("alone", code))
    lines = host.log("alone").read_text().splitlines()
    assert lines == ["True /dev/null", f"[0, 1, 2] {host.state}/work"]


def test_a_process_starts_with_every_signal_at_its_default(host, client):
    """No signal is blocked, or ignored because the supervisor or its Python ignores it."""
    host.run(client, host.order("signals", "grep", "-E", "SigBlk|SigIgn", "/proc/self/status"))
    _, blocked, _, ignored = host.log("signals").read_text().split()
    own_to_glibc = 1 << 31 | 1 << 32  # signals 32 and 33, which its posix_spawn ignores
    assert int(blocked, 16) == 0
    assert int(ignored, 16) & ~own_to_glibc == 0


def test_a_process_has_the_usual_timer_slack(host):
    """A slave has none, and a child inherits that; the supervisor sets the usual slack again."""
    timer_slack.use_exact_timers()
    try:
        client = host.connect()
    finally:
        timer_slack.use_usual_timers()
    host.run(client, host.order("slack", "cat", "/proc/self/timerslack_ns"))
    assert host.log("slack").read_text() == "50000\n"


def test_a_process_has_only_its_own_environment_and_directory(host, client, tmp_path):
    """Environment and directory are those of the order, plus two marks of the supervisor."""
    order = host.order(
        "env", "/usr/bin/env", environment={"A": "1"}, working_directory=str(tmp_path)
    )
    host.run(client, order)
    lines = sorted(host.log("env").read_text().splitlines())
    assert lines == ["A=1", "ROSRM_INSTANCE=env#1", f"ROSRM_SUPERVISOR={host.state}"]


def test_a_process_has_the_umask_of_the_user(host, monkeypatch):
    """The slave keeps its own files from others; the programs of users decide about theirs."""
    monkeypatch.setattr(private_files, "_user_umask", 0o027)
    before = os.umask(0o077)
    try:
        client = host.connect()
    finally:
        os.umask(before)
    host.run(client, host.order("job", "sh", "-c", "umask"))
    assert host.log("job").read_text() == "0027\n"


def test_environments_of_one_batch_stay_apart(host, client):
    """Variables added, changed or omitted against the first order arrive as ordered."""
    first = {"PATH": os.environ["PATH"], "A": "1", "B": "2"}
    second = {"PATH": os.environ["PATH"], "A": "3", "C": "4"}
    command = ("sh", "-c", "echo $A,$B,$C")
    client.start(
        [
            host.order("first", *command, environment=first),
            host.order("second", *command, environment=second),
        ]
    )
    for name, said in (("first", "1,2,\n"), ("second", "3,,4\n")):
        log = host.log(name)
        wait_until(partial(_written, log), f"output of {name}")
        assert log.read_text() == said


def _written(log):
    return log.exists() and log.read_text()


def test_a_process_that_ignores_everything_is_killed(host, client):
    """Each of SIGINT, SIGTERM, SIGKILL is reported when sent, and named in the final message."""
    client.start([host.python("deaf", IGNORES_ALL)])
    pid = host.running(client, "deaf").pid
    wait_until(lambda: host.log("deaf").read_text(), "it said that it is deaf")
    client.send(StopOrdered(("deaf", 1)))
    told = []
    while not told or not told[-1].state.ended:
        told += client.receive(10)
    steps = [status.message for status in told if status.state is InstanceState.STOPPING]
    assert [step.split(", ")[-1].split()[0] for step in steps] == ["SIGINT", "SIGTERM", "SIGKILL"]
    assert told[-1].state is InstanceState.EXITED
    times = re.match(
        "stopped by SIGINT, SIGTERM after (.*) s, SIGKILL after (.*) s", told[-1].message
    )
    assert times, told[-1].message
    terminated, killed = map(float, times.groups())
    assert 0.3 <= terminated <= killed - 0.2  # both are rounded
    assert killed >= 0.6
    wait_gone(pid)


def test_a_stop_reaches_the_whole_group(host, client):
    """A stop also ends the children of the process."""
    client.start([host.order("group", "sh", "-c", "sleep 1000 & sleep 1000 & wait")])
    host.running(client, "group")
    wait_until(lambda: len(host.alive()) == 3, "a shell and two sleeps run")
    client.send(StopOrdered(("group", 1)))
    host.ended(client, "group")
    assert host.alive() == []


def test_children_that_survive_their_leader_are_stopped(host, client):
    """A child of an exited leader ends before the instance does; the leader's exit code is kept."""
    status = host.run(client, host.order("leaver", "sh", "-c", "sleep 1000 & exit 4"))
    assert (status.state, status.exit_code) == (InstanceState.FAILED, 4)
    assert host.alive() == []


def test_a_daemon_that_left_the_session_is_found(host, client):
    """A daemon that left the session by two forks and setsid is still stopped."""
    status = host.run(client, host.python("daemon", DAEMON))
    assert status.state is InstanceState.EXITED
    wait_gone(int((host.state / "work" / "daemon.pid").read_text()))
    assert host.alive() == []


@pytest.mark.parametrize(
    ("argv", "directory", "said"),
    [
        (("no-such-program",), None, "program 'no-such-program' is not on the PATH\nthe PATH is /"),
        (("/no/such/program",), None, "no executable '/no/such/program' exists"),
        (("/etc/passwd",), None, "/etc/passwd cannot be started: it is not executable"),
        (("./run.sh",), "{tmp}", "no executable '{tmp}/./run.sh' exists"),
        (("true",), "/no/such/folder", "the working directory '/no/such/folder' cannot be"),
        (("{tmp}/orphaned-script",), None, "the interpreter in its first line does not exist"),
        (("{tmp}/nonsense",), None, "neither a program nor a script"),
    ],
)
def test_what_cannot_be_started_says_why(host, client, tmp_path, argv, directory, said):
    """The start is refused at once with a reason, because another host may have the program.

    The restart policy does not apply.
    """
    for name, text in (("orphaned-script", "#!/no/such/interpreter\n"), ("nonsense", "x\n")):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o700)
    argv = tuple(word.replace("{tmp}", str(tmp_path)) for word in argv)
    directory = directory and directory.replace("{tmp}", str(tmp_path))
    restart = RestartPolicy(when="always")
    order = host.order("broken", *argv, working_directory=directory, restart=restart)
    status = host.run(client, order)
    assert status.state is InstanceState.REFUSED
    assert said.replace("{tmp}", str(tmp_path)) in status.message


def test_restarts_back_off_and_run_out(host, client):
    """A failing process is restarted after growing delays, until its attempts are used up."""
    policy = RestartPolicy(when="on-failure", delay=0.05, factor=2.0, attempts=3)
    order = host.order("flaky", "sh", "-c", "date +%s.%N; exit 1", restart=policy)
    status = host.run(client, order)
    assert status.state is InstanceState.FAILED
    assert status.restarts == 3
    times = [float(line) for line in host.log("flaky").read_text().split()]
    assert len(times) == 4
    waits = [later - earlier for earlier, later in itertools.pairwise(times)]
    # A delay may be a fifth shorter, so that processes that crash together restart apart.
    assert all(wait >= 0.8 * most for wait, most in zip(waits, (0.05, 0.1, 0.2), strict=True))


@pytest.mark.parametrize("killed", ["never", "after"])
def test_a_stopped_process_ends_and_starts_again(host, client, killed):
    """The order ends the whole paused tree, which SIGINT cannot reach, and survives a kill."""
    again = RestartPolicy("on-failure", delay=0.05)
    client.start([host.order("hung", "sh", "-c", "sleep 1000; true", restart=again)])
    pid = host.running(client, "hung").pid
    os.kill(pid, signal.SIGSTOP)
    client.send(FailOrdered(("hung", 1), pid, "unhealthy: stopped for 5 s", kill=True))
    if killed == "after":
        host.wait(client, "hung", InstanceState.STOPPING, InstanceState.BACKOFF)
        client = host.replace_supervisor(client)
        found = [one for one in client.instances if one.pid not in (0, pid)]
    else:
        assert host.wait(client, "hung", InstanceState.BACKOFF).message.startswith("unhealthy: st")
        found = []
    found = found or [host.running(client, "hung")]
    assert found[0].pid != pid
    wait_gone(pid)


def test_a_start_is_reported_once_its_process_runs(host, client):
    """The first status of a start that need not wait for other starts has the process."""
    client.start([host.order("prompt", "sleep", "1000")])
    status, *others = client.receive(PATIENCE)
    assert (status.state, others) == (InstanceState.RUNNING, [])
    assert status.pid > 0
