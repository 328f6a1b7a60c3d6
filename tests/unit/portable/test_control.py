"""Requests to a node by files: delivery, waiting and refusal, with real processes."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from rosrm.errors import PortableError
from rosrm_criu.control import listener
from rosrm_criu.control.client import (
    ask_prepare,
    ask_resume,
    await_joined,
    await_left,
    control_directory,
    directory_of,
    make_directory,
)
from rosrm_criu.control.directory import remove_directory
from rosrm_criu.control.listener import Listener
from rosrm_criu.control.messages import (
    SIGNAL,
    VARIABLE,
    Request,
    State,
    Status,
    Want,
    read_message,
    write_message,
)

PATIENCE = 20.0


@pytest.fixture
def directory(tmp_path):
    return tmp_path / "c"


@pytest.fixture
def node(directory):
    """Return the listener of a running node."""
    listener = Listener(directory)
    listener.report(Status(State.RUNNING))
    return listener


@pytest.fixture
def start():
    """Return a function that starts Python programs; kill them at the end."""
    started = []

    def start(program: str) -> subprocess.Popen:
        # Short sleeps: a signal just before the call of one is handled at its end only.
        waits = "import time\nwhile True: time.sleep(0.1)"
        process = subprocess.Popen(
            [sys.executable, "-c", f"{program}\nprint('on', flush=True)\n{waits}"],
            stdout=subprocess.PIPE,
        )
        started.append(process)
        assert process.stdout.readline() == b"on\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def leave(node: Listener) -> Request:
    request = node.next_request()
    assert request.want is Want.LEAVE
    node.report(Status(State.LEAVING, request.id))
    node.report(Status(State.LEFT, request.id))
    return request


def join(node: Listener) -> Request:
    request = node.next_request()
    assert request.want is Want.JOIN
    node.enter(State.JOINING, request.id)
    node.finish(Status(State.RUNNING, request.id))
    return request


# --- successful requests ---


def test_a_node_leaves_and_joins_when_it_is_asked_to(directory, node) -> None:
    """The node gets each request once, and clients that wait see each state."""
    ask_prepare(directory, None, "m1")
    assert leave(node) == Request("m1", Want.LEAVE)
    assert await_left(directory, "m1", 0.0).state is State.LEFT
    assert node.next_request() is None
    ask_resume(directory, None, "m1")
    assert join(node) == Request("m1", Want.JOIN)
    assert await_joined(directory, "m1", 0.0).state is State.RUNNING


def test_what_is_awaited_may_come_later(directory, node) -> None:
    """A wait ends with the node's answer, before the timeout."""
    ask_prepare(directory, None, "m1")
    later = threading.Timer(0.1, leave, [node])
    later.start()
    assert await_left(directory, "m1", PATIENCE).request == "m1"
    later.join()


def test_times_and_missing_peers_arrive(directory, node) -> None:
    """A client reads the status exactly as the node wrote it."""
    status = Status(State.RUNNING, "m1", "", {"leave": 0.25}, ("readers of /count: 0 of 1",))
    node.report(status)
    assert read_message(directory, Status) == status


def test_the_directory_of_a_process_is_found_in_the_middle_of_its_execve(directory) -> None:
    """The directory is found even while the child's execve has not set the environment yet."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        for _ in range(20):
            with subprocess.Popen(
                ["sleep", "60"], env={**os.environ, VARIABLE: str(directory)}
            ) as process:
                try:
                    assert directory_of(process.pid) == directory
                finally:
                    process.kill()
    finally:
        os.sched_setaffinity(0, allowed)


# --- repeated, late and reordered requests ---


def test_a_request_that_comes_twice_does_nothing(directory, node) -> None:
    """A repeated request has no effect, neither while the node is away nor after its rejoin."""
    for _ in range(2):
        ask_prepare(directory, None, "m1")
    leave(node)
    ask_prepare(directory, None, "m1")
    assert node.next_request() is None
    ask_resume(directory, None, "m1")
    join(node)
    ask_resume(directory, None, "m1")
    assert node.next_request() is None
    ask_prepare(directory, None, "m1")
    assert node.next_request() is None
    assert read_message(directory, Status).state is State.RUNNING


def test_a_node_that_is_called_back_before_it_left_stays(directory, node) -> None:
    """A withdrawn departure fails its wait, and a late request of its attempt has no effect."""
    ask_prepare(directory, None, "m1")
    ask_resume(directory, None, "m1")
    assert node.next_request() is None
    assert await_joined(directory, "m1", 0.0).state is State.RUNNING
    with pytest.raises(PortableError, match="asked to stay"):
        await_left(directory, "m1", 0.0)
    write_message(directory, Request("m1", Want.LEAVE))
    assert node.next_request() is None


def test_a_node_that_is_away_answers_another_request_to_leave(directory, node) -> None:
    """A node that is away confirms another departure; one rejoin with any newer id ends both."""
    ask_prepare(directory, None, "m1")
    leave(node)
    ask_prepare(directory, None, "m2")
    assert node.next_request() is None
    assert await_left(directory, "m2", 0.0).state is State.LEFT
    ask_resume(directory, None, "m3")
    join(node)
    for late in ("m1", "m2", "m3"):
        write_message(directory, Request(late, Want.LEAVE))
        assert node.next_request() is None


def test_what_an_earlier_process_was_asked_does_not_count(directory, node) -> None:
    """A new process in the same directory ignores the old process's files."""
    ask_prepare(directory, None, "m1")
    leave(node)
    again = Listener(directory)
    assert read_message(directory, Status) is None
    again.report(Status(State.RUNNING))
    assert again.next_request() is None


def test_what_an_earlier_process_was_asked_can_be_asked_again(directory, node) -> None:
    """A new process accepts a used id, because a cluster without its journal assigns it again."""
    ask_prepare(directory, None, "m1")
    leave(node)
    again = Listener(directory)
    again.report(Status(State.RUNNING))
    ask_prepare(directory, None, "m1")
    leave(again)


def test_a_restored_node_finds_what_was_asked_at_the_same_path(directory, node) -> None:
    """The directory may be created again, with the request in it before the node runs again."""
    ask_prepare(directory, None, "m1")
    leave(node)
    remove_directory(directory)
    assert node.next_request() is None
    make_directory(directory)
    ask_resume(directory, None, "m1")
    join(node)
    assert await_joined(directory, "m1", 0.0).state is State.RUNNING


# --- refusals, failures and missing nodes ---


def test_a_node_that_does_not_leave_reports_why(directory, node) -> None:
    """A refusal ends the wait with its reason, and the node still runs."""
    ask_prepare(directory, None, "m1")
    request = node.next_request()
    node.finish(Status(State.RUNNING, request.id, "sockets are open"))
    with pytest.raises(PortableError, match="does not leave the ROS graph: sockets are open"):
        await_left(directory, "m1", 0.0)


def test_a_node_that_cannot_join_reports_why(directory, node) -> None:
    """A failure of the node ends any wait at once with its reason."""
    node.report(Status(State.FAILED, "m1", "ValueError: no camera"))
    with pytest.raises(PortableError, match="cannot join the ROS graph again: ValueError: no cam"):
        await_joined(directory, "m1", PATIENCE)
    with pytest.raises(PortableError, match="has failed: ValueError: no camera"):
        ask_prepare(directory, None, "m2")


def test_a_status_that_is_nested_deeply_is_refused(directory, node) -> None:
    """The node may belong to another user than the slave that reads its status."""
    (directory / "status").write_text("[" * 60_000)
    with pytest.raises(PortableError, match="holds no JSON"):
        await_joined(directory, "m1", PATIENCE)


def test_a_process_without_a_portable_node_is_not_asked(directory) -> None:
    """A request without a status fails; the error names `run_portable`."""
    with pytest.raises(PortableError, match="run_portable"):
        ask_prepare(directory, None, "m1")


def test_the_signal_is_not_sent_to_a_process_that_it_would_end(directory, node, start) -> None:
    """A process that neither catches nor blocks the signal gets no request, and survives."""
    process = start("")
    with pytest.raises(PortableError, match=f"does not catch signal {SIGNAL}"):
        ask_prepare(directory, process.pid, "m1")
    assert node.next_request() is None
    assert process.poll() is None


CATCHES = "import signal, os; signal.signal({0}, lambda *_: os._exit(42))"
BLOCKS = """
import signal, os, threading
signal.pthread_sigmask(signal.SIG_BLOCK, [{0}])
threading.Thread(target=lambda: (signal.sigwait([{0}]), os._exit(42))).start()
"""


@pytest.mark.parametrize("how", [CATCHES, BLOCKS], ids=["caught", "blocked"])
def test_the_signal_wakes_a_process_that_catches_or_awaits_it(directory, node, start, how) -> None:
    """A process that catches or blocks the signal gets the request and the signal."""
    process = start(how.format(SIGNAL))
    ask_prepare(directory, process.pid, "m1")
    assert process.wait(PATIENCE) == 42
    assert read_message(directory, Request) == Request("m1", Want.LEAVE)


def test_a_process_that_has_ended_is_not_waited_for(directory, node, start) -> None:
    """A wait for an ended process fails at once, also before the process is reaped."""
    process = start("")
    ask_prepare(directory, None, "m1")
    process.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    for _ in range(2):  # first a zombie, then reaped
        with pytest.raises(PortableError, match=f"process {process.pid} has ended"):
            await_left(directory, "m1", PATIENCE, process.pid)
        process.wait()


def test_a_stopped_process_is_named_when_the_time_has_passed(directory, node, start) -> None:
    """The timeout error names the awaited state, the request, and the stopped process."""
    process = start("")
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED)
    ask_prepare(directory, None, "m1")
    with pytest.raises(PortableError) as caught:
        await_left(directory, "m1", 0.05, process.pid)
    said = str(caught.value)
    assert "has not left the ROS graph within 0.05 s (request m1" in said
    assert "running and has not taken the request up" in said
    assert f"process {process.pid} is stopped" in said


def test_the_time_out_of_joining_reports_the_progress(directory, node) -> None:
    """The timeout error names the node's state, and no process if none was given."""
    ask_prepare(directory, None, "m1")
    leave(node)
    with pytest.raises(PortableError, match=r"joined .* again within 0 s .*: it is left$"):
        await_joined(directory, "m1", 0.0)


# --- the files ---


def test_a_node_that_waits_opens_nothing(directory, node, monkeypatch) -> None:
    """A waiting node opens no file, because an open file must exist on the destination too."""
    ask_prepare(directory, None, "m1")
    leave(node)
    with monkeypatch.context() as waiting:
        waiting.setattr(os, "open", lambda *_, **__: pytest.fail("a file was opened"))
        assert node.next_request() is None
    ask_resume(directory, None, "m1")
    assert join(node) == Request("m1", Want.JOIN)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b'{"format": 2}', b'{"format": 1}', b"\xff",
     b'{"format": 1, "state": "asleep", "request": "", "fault": "", "seconds": {}, "missing": []}',
     b'{"format": 1, "state": "left", "request": 7, "fault": "", "seconds": {}, "missing": []}'],
)  # fmt: skip
def test_a_damaged_status_is_reported(directory, node, content) -> None:
    """A damaged status raises an error that names the file."""
    (directory / "status").write_bytes(content)
    with pytest.raises(PortableError, match="status"):
        read_message(directory, Status)


def test_a_damaged_request_is_left_alone(directory, node, capfd) -> None:
    """The node logs a damaged request once, runs on, and accepts the next request."""
    (directory / "request").write_bytes(b"nonsense")
    assert node.next_request() is None
    assert node.next_request() is None
    assert capfd.readouterr().err.count("holds no JSON") == 1
    ask_prepare(directory, None, "m1")
    assert leave(node).id == "m1"


def test_a_status_is_seen_as_a_whole(directory, node) -> None:
    """A reader sees one complete status or the other while they are replaced repeatedly."""
    over = threading.Event()
    one, other = Status(State.RUNNING, "a" * 2000), Status(State.LEFT, "b")

    def write() -> None:
        while not over.is_set():
            write_message(directory, one)
            write_message(directory, other)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        until = time.monotonic() + 0.3
        while time.monotonic() < until:
            assert read_message(directory, Status) in (one, other, Status(State.RUNNING))
    finally:
        over.set()
        writer.join()


def test_a_node_without_its_directory_keeps_running(directory, node, capfd) -> None:
    """A node with a removed directory logs the failed write and runs on."""
    remove_directory(directory)
    node.report(Status(State.LEFT, "m1"))
    assert node.status.state is State.LEFT
    assert "cannot be written" in capfd.readouterr().err


def test_a_status_that_found_no_room_is_written_once_there_is(directory, node, monkeypatch) -> None:
    """Otherwise no repeated request to join would find out that the node has joined."""
    monkeypatch.setattr(listener, "_RETRY", 0.0)
    ask_prepare(directory, None, "m1")
    leave(node)
    ask_resume(directory, None, "m1")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(listener, "write_message", full)
        join(node)
    ask_resume(directory, None, "m1")
    assert node.next_request() is None
    assert await_joined(directory, "m1", 0.0).state is State.RUNNING


def test_an_orderly_end_leaves_no_portable_node(directory, node) -> None:
    """A regular end removes the status and the directory."""
    node.close()
    assert read_message(directory, Status) is None
    assert not directory.exists()


def test_a_directory_is_readable_by_its_owner_alone(directory) -> None:
    """A control directory has mode 0700, because a writer could make the node leave."""
    make_directory(directory / "deep")
    assert (directory / "deep").stat().st_mode & 0o777 == 0o700
    assert directory.stat().st_mode & 0o777 == 0o700


def test_a_directory_that_others_can_write_is_refused(directory) -> None:
    """A parent directory that others can write to is refused."""
    directory.mkdir()
    directory.chmod(0o777)
    with pytest.raises(PortableError, match="open to all"):
        make_directory(directory / "deep")


def test_control_directories_differ_by_user_and_instance() -> None:
    """The path is the same on all hosts; a name that leads elsewhere is refused."""
    assert str(control_directory("c-p-7", 1000)) == "/tmp/rosrm-1000/portable/c-p-7"
    for bad in ("", "..", "a/b"):
        with pytest.raises(PortableError, match="plain file name"):
            control_directory(bad, 1000)
