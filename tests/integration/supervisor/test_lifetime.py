"""The supervisor's lifetime: take-over, refusal of a second one, and its end."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import psutil
import pytest

import rosrm
from rosrm.core.supervisor.events import ShutdownOrdered, StatusStored, StopOrdered
from rosrm.errors import SupervisorError
from rosrm.model.values import InstanceId, InstanceState, RestartPolicy
from rosrm.supervisor import descriptors, instance_record, messages, procfs
from rosrm.supervisor.client import SupervisorClient, SupervisorEnded
from rosrm.supervisor.messages import Forget
from tests.waiting import PATIENCE, command_of, wait_gone, wait_until

from .conftest import Host, kill

OURS = messages.PROTOCOL
MAIN = Path(procfs.__file__).with_name("__main__.py")

SLAVE = """
    import os, sys
    from pathlib import Path
    from rosrm.model.values import InstanceId
    from rosrm.supervisor.client_values import LaunchOrder
    from rosrm.supervisor.client import SupervisorClient
    client = SupervisorClient.connect(Path(sys.argv[1]))
    order = LaunchOrder(InstanceId("kept", 1), ("sleep", "1000"), dict(os.environ))
    client.start([order])
    while not any(status.pid for status in client.receive(10)): pass
    print(client.pid, flush=True)
    client.receive()
"""


def start_slave(host: Host) -> subprocess.Popen:
    """Start a slave process that is connected and has started `kept`."""
    root = str(Path(rosrm.__file__).parent.parent)
    slave = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SLAVE), str(host.state)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": root},
    )
    host.pids.add(int(slave.stdout.readline()))
    return slave


@pytest.fixture
def slave(host):
    slave = start_slave(host)
    yield slave
    slave.kill()
    slave.wait()
    slave.stdout.close()


def test_processes_survive_a_killed_slave(host, slave):
    """After a SIGKILL of the slave the next one finds the process and the same supervisor."""
    slave.kill()
    slave.wait()
    client = host.connect(start=False)
    (status,) = client.instances
    assert status.instance == InstanceId("kept", 1)
    assert status.state is InstanceState.RUNNING
    wait_until(lambda: command_of(status.pid).startswith("sleep"), "the process is executed")


def test_no_terminal_signal_of_the_slave_reaches_its_processes(host, slave):
    """Supervisor and process have sessions of their own, so Ctrl-C reaches neither."""
    supervisor = next(iter(host.pids))
    (process,) = wait_until(host.alive, "the process is executed")
    sessions = {os.getsid(slave.pid), os.getsid(supervisor), os.getsid(process)}
    assert len(sessions) == 3
    stat = procfs.read_stat(supervisor)
    assert stat.parent != slave.pid


def test_ps_names_the_supervisor_and_its_processes_as_their_programs(host, client):
    (supervisor,) = host.pids
    assert psutil.Process(supervisor).name() == "rosrm-superviso"  # the kernel keeps 15 bytes
    assert psutil.Process(host.sleeper(client, "one")).name() == "sleep"


def test_a_second_live_slave_is_refused(host, slave):
    """While one slave is connected, another is refused with the pid of the first."""
    with pytest.raises(SupervisorError, match=f"another slave .pid {slave.pid}. is connected"):
        host.connect()


@pytest.mark.parametrize("number", [OURS - 1, OURS + 1])
def test_a_slave_of_another_version_is_refused(host, client, monkeypatch, number):
    """The refusal names both versions; the supervisor's processes keep running."""
    pid = host.sleeper(client, "kept")
    client.close()
    with monkeypatch.context() as patched:
        patched.setattr(messages, "PROTOCOL", number)
        with pytest.raises(SupervisorError, match=f"speaks protocol {OURS}, you speak {number}"):
            host.connect()
    assert [status.pid for status in host.connect().instances] == [pid]


def test_final_statuses_are_kept_until_forgotten(host, client):
    """The supervisor reports final statuses at each connection until the client acknowledges."""
    final = host.run(client, host.order("job", "sh", "-c", "exit 5"))
    client = host.reconnect(client)
    assert client.instances == (final,)
    client.send(Forget((StatusStored(("job", 1)),)))
    client = host.reconnect(client)
    assert client.instances == ()


def test_a_killed_supervisor_is_taken_over(host, client):
    """After a SIGKILL the next supervisor has the same processes, and can stop them."""
    client.start([host.order("kept", "sh", "-c", "echo ran; sleep 1000 & wait")])
    before = host.running(client, "kept")
    wait_until(lambda: len(host.alive()) == 2, "the shell has started its sleep")
    client = host.replace_supervisor(client)
    (status,) = client.instances
    assert (status.state, status.pid) == (InstanceState.RUNNING, before.pid)
    client.send(StopOrdered(("kept", 1)))
    assert host.ended(client, "kept").state is InstanceState.EXITED
    assert host.alive() == []
    assert host.log("kept").read_text() == "ran\n"


def test_an_unobserved_end_is_reported_as_unknown(host, client):
    """A process that ended without a supervisor has failed, with exit code unknown; no restart."""
    pid = host.sleeper(client, "gone")
    host.kill_supervisor(client)
    kill(pid)
    client = host.connect()
    (status,) = client.instances
    assert (status.state, status.exit_code) == (InstanceState.FAILED, -1)
    assert "not known" in status.message


def test_what_a_dead_leader_left_is_stopped_after_a_take_over(host, client):
    """The next supervisor finds and stops the child of a dead leader."""
    client.start([host.order("leaver", "sh", "-c", "sleep 1000 & wait")])
    pid = host.running(client, "leaver").pid
    wait_until(lambda: len(host.alive()) == 2, "the shell has started its sleep")
    host.kill_supervisor(client)
    kill(pid)
    client = host.connect()
    host.ended(client, "leaver")
    assert host.alive() == []


def test_a_taken_over_process_that_ends_is_noticed(host, client):
    """The new supervisor is not the parent, and notices the end by the pidfd."""
    pid = host.sleeper(client, "kept")
    client = host.replace_supervisor(client)
    os.kill(pid, signal.SIGKILL)
    assert host.ended(client, "kept").exit_code == -1


def test_a_spawn_without_an_outcome_is_not_tried_again(host, client):
    """A kill between the spawn and its record: the process may have run, so no second run."""
    host.run(client, host.order("model", "touch", "ran"))
    host.kill_supervisor(client)
    host.cut_record(after_spawn=True)
    (host.state / "work" / "ran").unlink()
    client = host.connect()
    (status,) = client.instances
    assert status.state is InstanceState.FAILED
    assert "how that went is not known" in status.message
    assert not (host.state / "work" / "ran").exists()


def test_a_start_that_was_never_tried_is_carried_out(host, client):
    """A kill between the order's record and the spawn: the next supervisor spawns it, once."""
    host.run(client, host.order("model", "sh", "-c", "echo ran"))
    host.kill_supervisor(client)
    host.cut_record(after_spawn=False)
    host.log("model").unlink()
    client = host.connect()
    host.ended_after_connect(client, "model")
    assert host.log("model").read_text() == "ran\n"


def test_a_spawn_without_a_record_is_found_by_its_marks(host, client):
    """A kill right after the spawn: the next supervisor finds the unrecorded process."""
    pid = host.sleeper(client, "found")
    host.kill_supervisor(client)
    host.cut_record(after_spawn=True)
    client = host.connect()
    (status,) = client.instances
    assert (status.state, status.pid) == (InstanceState.RUNNING, pid)


def test_a_torn_tail_is_left_out_and_reported(host, client):
    """A record that ends in half a line is read up to there, and the client gets a note."""
    host.sleeper(client, "kept")
    host.kill_supervisor(client)
    with (host.state / "instances.jsonl").open("a") as record:
        record.write('{"record":"state","key":["ke')
    client = host.connect()
    assert client.instances[0].state is InstanceState.RUNNING
    assert any("torn line" in note for note in client.notes)


def test_a_damaged_line_is_left_out_and_reported(host, client):
    """An unreadable line is skipped, and the client gets a note with its line number."""
    host.run(client, host.order("job", "true"))
    host.kill_supervisor(client)
    record = host.state / "instances.jsonl"
    lines = record.read_text().splitlines(keepends=True)
    record.write_text("".join([*lines[:1], "\0\0 not JSON\n", *lines[1:]]))
    client = host.connect()
    assert client.instances[0].state is InstanceState.EXITED
    assert any("instances.jsonl:2" in note for note in client.notes)


def test_what_starts_after_the_record_was_compacted_is_taken_over(host, client):
    """Compaction with nothing running keeps the environment that the client sent once."""
    large = "x" * (instance_record.COMPACT_BYTES * 2 // 3)  # the second one exceeds the bound
    for number in (1, 2):
        host.run(client, host.order("large", "/no/such/program", memo=large, number=number))
    always = RestartPolicy(when="always", delay=0.01)
    code = "import os, time; print(os.environ.get('PATH'), flush=True); time.sleep(1000)"
    client.start([host.python("later", code, restart=always)])
    pid = host.running(client, "later").pid
    assert (host.state / "instances.jsonl").stat().st_size < instance_record.COMPACT_BYTES
    client = host.replace_supervisor(client)
    assert client.notes == ()
    assert {status.pid for status in client.instances} == {0, pid}
    os.kill(pid, signal.SIGKILL)
    assert host.running(client, "later").pid != pid
    wait_until(lambda: host.log("later").read_text().count(os.environ["PATH"]) == 2, "both runs")


def test_without_its_environment_nothing_is_restarted(host, client):
    """The process with a lost environment is taken over, but refused a restart, with the reason."""
    always = RestartPolicy(when="always", delay=0.01)
    pid = host.sleeper(client, "one", restart=always)
    host.kill_supervisor(client)
    path = host.state / "instances.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    kept = [b"spoilt\n" if b'"variables"' in line else line for line in lines]
    path.write_bytes(b"".join(kept))
    client = host.connect()
    (note,) = client.notes
    assert "left out" in note
    (status,) = client.instances
    assert status.pid == pid
    os.kill(pid, signal.SIGKILL)
    ended = host.ended(client, "one")
    assert ended.state is InstanceState.REFUSED  # the master starts it elsewhere
    assert "its environment was lost" in ended.message


def test_a_second_supervisor_is_refused(host, client):
    """A second supervisor on a state directory ends with the pid of the first."""
    command = [sys.executable, "-m", "rosrm.supervisor", "--state", str(host.state)]
    root = str(Path(rosrm.__file__).parent.parent)
    result = subprocess.run(
        [*command, "--foreground"],
        capture_output=True,
        text=True,
        timeout=20,
        env={**os.environ, "PYTHONPATH": root},
        check=False,
    )
    assert result.returncode == 1
    assert f"another supervisor (pid {client.pid}) serves" in result.stderr


def test_two_slaves_that_start_at_once_get_one_supervisor(host):
    """Both slaves try to start it; one supervisor serves, and the second slave is refused."""
    outcomes: list[object] = []

    def connect() -> None:
        try:
            outcomes.append(host.connect())
        except SupervisorError as error:
            outcomes.append(error)

    threads = [threading.Thread(target=connect) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (error,) = [outcome for outcome in outcomes if isinstance(outcome, SupervisorError)]
    assert "another slave" in str(error)
    assert len(host.pids) == 1


def test_a_long_path_is_no_trouble(tmp_path):
    """A state directory may be deeper than the 108 bytes of a Unix socket's path."""
    host = Host(tmp_path / ("deep" * 20) / ("deeper" * 20))
    try:
        client = host.connect()
        assert host.run(client, host.order("job", "true")).state is InstanceState.EXITED
    finally:
        host.clean_up()


def test_no_supervisor_is_started_unless_asked(host):
    """With `start=False` a client only connects."""
    with pytest.raises(SupervisorError, match="no supervisor serves"):
        host.connect(start=False)
    assert not host.state.exists()


def test_an_unusable_state_directory_is_reported(tmp_path):
    """The error names the directory that cannot be created, at once."""
    (tmp_path / "file").write_text("")
    with pytest.raises(SupervisorError, match="file/state cannot be used"):
        SupervisorClient.connect(tmp_path / "file" / "state")


def test_a_back_off_of_decades_ends_no_supervisor(host):
    """A time-out of more than 24 days is an error of `epoll`: each successor died at once."""
    client = host.connect()
    policy = RestartPolicy("always", delay=1e9, max_delay=1e9)
    client.start([host.order("crash", "false", restart=policy)])
    host.wait(client, "crash", InstanceState.BACKOFF)
    for _ in range(2):
        client = host.replace_supervisor(client)
        assert host.run(client, host.order(f"job{client.pid}", "true")).exit_code == 0
    client.send(StopOrdered(("crash", 1)))
    assert host.ended_after_connect(client, "crash").state is InstanceState.EXITED


def test_a_damaged_record_ends_no_supervisor(host):
    """The rest of the record counts, and the supervisor reports what it left out."""
    client = host.connect()
    pid = host.sleeper(client, "stays")
    host.kill_supervisor(client)
    with (host.state / "instances.jsonl").open("ab") as record:
        record.write(b"[" * 100_000 + b"\n")
        record.write(b'{"record":"state","birth":1,"key":["a",1e999],"phase":9}\n' * 50_000)
    client = host.connect()
    assert len(client.notes) < 30
    assert [one.pid for one in client.instances] == [pid]


def test_shutdown_ends_everything_and_leaves_nothing(host, client):
    """After the shutdown no process, no socket and no supervisor is left."""
    client.start([host.order("a", "sleep", "1000"), host.order("b", "sleep", "1000")])
    host.running(client, "b")
    client.send(ShutdownOrdered())
    with pytest.raises(SupervisorEnded):
        list(iter(lambda: client.receive(10), []))
    wait_gone(client.pid)
    assert host.alive() == []
    assert not (host.state / "supervisor.sock").exists()


def test_a_supervisor_without_client_and_processes_ends(host):
    """A supervisor without a client ends when all its processes have ended."""
    first = host.connect()
    first.start([host.python("p", "import sys; sys.stdin.read(); input()")])
    assert host.ended(first, "p").exit_code == 1
    first.close()
    wait_gone(first.pid)
    second = host.connect()
    assert second.pid != first.pid
    assert [status.exit_code for status in second.instances] == [1]


def test_a_supervisor_without_client_ends_with_its_last_process(host):
    """A supervisor without a client ends with its last process."""
    first = host.connect()
    first.start([host.python("p", "import time; time.sleep(1000)")])
    pid = host.running(first, "p").pid
    first.close()
    second = host.connect()
    assert second.pid == first.pid
    second.close()
    os.kill(pid, signal.SIGKILL)
    wait_gone(second.pid)
    assert host.connect().instances[0].exit_signal == signal.SIGKILL


def test_a_lost_supervisor_is_reported(host, client):
    """A waiting slave is notified at once of the end of its supervisor."""
    os.kill(client.pid, signal.SIGKILL)
    with pytest.raises(SupervisorError, match="is gone; its processes keep running"):
        client.receive(10)


def test_orders_pass_while_another_thread_waits(host, client):
    """While one thread blocks in `receive`, another can send orders; the answer wakes the first."""
    received = []
    thread = threading.Thread(target=lambda: received.extend(client.receive(PATIENCE)))
    thread.start()
    client.start([host.order("job", "true")])
    thread.join(PATIENCE)
    assert received


def test_an_idle_supervisor_sleeps(host, client):
    """Without processes or orders the supervisor is not scheduled at all."""
    host.run(client, host.order("job", "true"))

    def switches() -> str:
        status = Path(f"/proc/{client.pid}/status").read_text()
        return status[status.index("voluntary_ctxt_switches") :]

    for _ in range(5):  # on a busy machine it takes a while to go to sleep
        before = switches()
        time.sleep(1.0)
        if switches() == before:
            break
    assert switches() == before


def test_the_supervisor_imports_nothing_heavy():
    """The supervisor's modules import the standard library only, and little of it."""
    root = str(Path(rosrm.__file__).parent.parent)
    code = f"import sys; sys.path.append({root!r}); import rosrm.supervisor.server"
    code += "; print(*sys.modules)"
    command = [sys.executable, "-I", "-S", "-c", code]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    roots = {name.partition(".")[0] for name in loaded}
    assert roots - {"rosrm"} <= set(sys.stdlib_module_names) | {"__main__"}
    heavy = {"asyncio", "ctypes", "dataclasses", "inspect", "logging", "pathlib", "subprocess"}
    assert roots & heavy == set()
    assert "rosrm.model.values" not in loaded


def test_the_supervisor_is_small(client):
    """The supervisor uses at most 12 MiB, alone on the machine (about 8 beside other Pythons)."""
    rollup = Path(f"/proc/{client.pid}/smaps_rollup").read_text().split()
    assert int(rollup[rollup.index("Pss:") + 1]) < 12 * 1024


def test_the_supervisor_may_open_more_files_than_its_processes(host):
    """Each taken-over process needs a descriptor, but programs with `select` fail above 1023."""
    former, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    soft = 64
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:
        client = host.connect()
        client.start([host.order(f"p{number}", "sleep", "1000") for number in range(soft)])
        up: set[str] = set()
        wait_until(
            lambda: up.update(one.instance.process for one in client.receive(1.0) if one.pid)
            or len(up) == soft, "all processes", seen=lambda: up,
        )  # fmt: skip
        client = host.replace_supervisor(client)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (former, hard))
    assert resource.prlimit(client.pid, resource.RLIMIT_NOFILE) == (hard, hard)
    pid = host.sleeper(client, "later")
    assert resource.prlimit(pid, resource.RLIMIT_NOFILE) == (soft, hard)


def test_more_processes_than_descriptors_are_taken_over(host):
    """None counts as ended, and the end of each is found."""
    client = host.connect()
    names = [f"p{number}" for number in range(20)]
    pids = [host.sleeper(client, name) for name in names]
    kill(client.pid)
    few = descriptors.RESERVE + 10
    started = subprocess.run(
        [sys.executable, str(MAIN), "--state", str(host.state)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (few, few)),
        stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    assert started.stdout == b"ready\n"
    client = host.connect(start=False)
    assert [one.pid for one in client.instances] == pids
    assert {one.state for one in client.instances} == {InstanceState.RUNNING}
    for name, pid in zip(names, pids, strict=True):
        os.kill(pid, signal.SIGKILL)
        host.wait(client, name, InstanceState.FAILED)
