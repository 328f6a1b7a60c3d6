"""A node that leaves the ROS graph and joins it again, its memory as it was: real processes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Int64, Int64MultiArray
from std_srvs.srv import Trigger

from rosrm.errors import PortableError
from rosrm_criu.control.client import ask_prepare, ask_resume, await_joined, await_left
from rosrm_criu.control.messages import VARIABLE, State, Status, read_message
from rosrm_examples.portable_counter import filled
from tests.ros.clusters import wait_until
from tests.ros.nodes import PATIENCE

PROGRAM = Path(__file__).parent / "programs" / "portable.py"


class Portable:
    """A portable node in a process of its own."""

    def __init__(
        self, folder: Path, domain: int, fault: str = "", *, words=(), command=None, controlled=True
    ):
        self.directory = folder / "control"
        self.log = folder / "log"
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        if controlled:
            environment[VARIABLE] = str(self.directory)
        command = [*words, *(command or [sys.executable, str(PROGRAM), fault])]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        self.pid = self.process.pid

    def runs(self) -> bool:
        assert self.process.poll() is None, self.said()
        status = read_message(self.directory, Status)
        return status is not None and status.state is State.RUNNING

    def prepare(self, request: str):
        ask_prepare(self.directory, self.pid, request)
        return await_left(self.directory, request, PATIENCE, self.pid)

    def resume(self, request: str):
        ask_resume(self.directory, self.pid, request)
        return await_joined(self.directory, request, PATIENCE, self.pid)

    def threads(self) -> list[str]:
        tasks = Path(f"/proc/{self.pid}/task").iterdir()
        return [(one / "comm").read_text().strip() for one in tasks]

    def files(self) -> list[str]:
        return [str(one.readlink()) for one in Path(f"/proc/{self.pid}/fd").iterdir()]

    def said(self) -> str:
        return self.log.read_text(errors="replace")

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def start(tmp_path, stage):
    """Starts a portable node; one that is controlled runs when this returns."""
    started = []

    def start(fault: str = "", *, wait: bool = True, **named) -> Portable:
        one = Portable(tmp_path, stage.domain, fault, **named)
        started.append(one)
        if wait:
            stage.spin_until(one.runs, "a portable node")
        return one

    yield start
    for one in started:
        one.end()


@pytest.fixture
def heard(stage):
    return stage.listen(Int64, "count")


def numbers(heard: list) -> list[int]:
    return [message.data for message in heard]


def hear_more(stage, heard: list, more: int = 10) -> None:
    enough = len(heard) + more
    stage.spin_until(lambda: len(heard) >= enough, f"{more} more counts")


def counts_on(heard: list) -> bool:
    """One by one: none is lost, none comes twice."""
    found = numbers(heard)
    return found == list(range(found[0], found[0] + len(found)))


def call(stage, service_type, name: str, request):
    client = stage.plain.create_client(service_type, name)
    stage.spin_until(client.service_is_ready, f"the service {name}")
    future = client.call_async(request)
    stage.spin_until(future.done, f"an answer of {name}")
    stage.plain.destroy_client(client)
    return future.result()


def report(stage) -> dict[str, float]:
    words = call(stage, Trigger, "total", Trigger.Request()).message.split()
    return dict(zip(("joined", "step", "limit", "due", "once"), map(float, words), strict=True))


def test_a_node_that_has_left_holds_nothing_of_ros(stage, start, heard) -> None:
    """No thread of DDS, no socket, nothing but its output: CRIU can dump it."""
    node = start()
    hear_more(stage, heard)
    assert any(one.startswith("dds.") for one in node.threads())
    status = node.prepare("m1")
    assert status.state is State.LEFT
    assert 0 < status.seconds["leave"] < PATIENCE
    assert not [one for one in node.threads() if one.startswith("dds.")]
    # It says that it has left by a file, whose folders it holds open for that moment.
    allowed = {"/dev/null", str(node.log)}
    wait_until(lambda: set(node.files()) <= allowed, "nothing open but its output")
    stage.spin_until(lambda: stage.plain.count_publishers("/count") == 0, "the node to be gone")


def test_a_counter_goes_on_where_it_left(stage, start, heard) -> None:
    """Three absences: a subscriber hears each number once and in order, and none is missing."""
    node = start()
    hear_more(stage, heard)
    for move in ("m1", "m2", "m3"):
        node.prepare(move)
        so_far = len(heard)
        status = node.resume(move)
        assert not status.missing
        stage.spin_until(lambda before=so_far: len(heard) >= before + 10, "counts after the move")
    assert counts_on(heard), numbers(heard)
    assert report(stage)["joined"] == 4


def test_participants_are_new_after_each_absence(stage, start, heard) -> None:
    """No GUID comes twice, not even its part by chance: one image may be restored twice."""
    node = start()
    seen = []
    for move in ("m1", "m2"):
        hear_more(stage, heard)
        stage.spin_until(lambda: stage.plain.count_publishers("/count") == 1, "one publisher")
        (info,) = stage.plain.get_publishers_info_by_topic("/count")
        seen.append(bytes(info.endpoint_gid)[:8])
        node.prepare(move)
        stage.spin_until(lambda: stage.plain.count_publishers("/count") == 0, "no publisher")
        node.resume(move)
    assert len(set(seen)) == 2
    assert {one[4:6] for one in seen} == {(node.pid & 0xFFFF).to_bytes(2, "little")}


def test_to_leave_twice_is_to_leave_once(stage, start, heard) -> None:
    """The same request again does nothing, before and after it is back."""
    node = start()
    hear_more(stage, heard)
    node.prepare("m1")
    node.prepare("m1")
    node.resume("m1")
    node.resume("m1")
    hear_more(stage, heard)
    ask_prepare(node.directory, node.pid, "m1")
    hear_more(stage, heard, 30)
    assert node.runs()
    assert report(stage)["joined"] == 2
    assert counts_on(heard), numbers(heard)


def test_a_node_that_is_called_back_at_once_runs_on(stage, start, heard) -> None:
    """The node runs and counts on, whether it had left or not."""
    node = start()
    hear_more(stage, heard)
    ask_prepare(node.directory, node.pid, "m1")
    assert node.resume("m1").state is State.RUNNING
    hear_more(stage, heard)
    assert counts_on(heard), numbers(heard)


def test_parameters_and_timers_are_as_they_were(stage, start, heard) -> None:
    """Parameters keep their values, timers their position; a cancelled timer stays cancelled."""
    node = start()
    hear_more(stage, heard)
    values = [Parameter("step", value=3), Parameter("limit", value=7.5)]
    request = SetParameters.Request(parameters=[one.to_parameter_msg() for one in values])
    answer = call(stage, SetParameters, "brain/set_parameters", request)
    assert all(one.successful for one in answer.results)
    time.sleep(1.0)  # of a period of 100 s: a restarted timer would show it
    before = report(stage)
    node.prepare("m1")
    node.resume("m1")
    after = report(stage)
    assert (after["step"], after["limit"]) == (3, 7.5)
    assert 0 < after["due"] <= before["due"] < 99.5
    assert before["once"] == after["once"] == 1


def test_a_callback_is_not_cut_in_half(stage, start, heard) -> None:
    """The callback ends and does not run again: its output comes once."""
    node = start("long callback")
    hear_more(stage, heard, 2)
    node.prepare("m1")
    node.resume("m1")
    hear_more(stage, heard, 2)
    assert len(set(numbers(heard))) == len(heard)


def test_callbacks_in_threads_come_to_rest(stage, start, heard) -> None:
    """The same holds for an executor of several threads."""
    node = start("threads")
    hear_more(stage, heard)
    for move in ("m1", "m2"):
        node.prepare(move)
        node.resume(move)
        hear_more(stage, heard)
    assert counts_on(heard), numbers(heard)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("leave fails", "Brain.leave raised ValueError: the arm is moving"),
        ("socket", r"sockets are open \(file descriptors \d+\): close them in leave\(\)"),
        ("other node", r"threads dds\..*destroy it in leave\(\)"),
    ],
)
def test_a_node_that_cannot_leave_stays_and_says_why(stage, start, heard, fault, said) -> None:
    """The client gets one sentence; the node works as before."""
    node = start(fault)
    hear_more(stage, heard)
    with pytest.raises(PortableError, match=said):
        node.prepare("m1")
    hear_more(stage, heard)
    assert counts_on(heard), numbers(heard)
    assert re.search(said, node.said())


def test_a_node_that_cannot_join_again_fails_and_says_why(stage, start) -> None:
    """The client gets the error of `join`; the process ends with the traceback in its log."""
    node = start("join fails")
    node.prepare("m1")
    with pytest.raises(PortableError, match="ValueError: no camera here"):
        node.resume("m1")
    assert node.process.wait(PATIENCE) == 1
    assert "Traceback" in node.said()


def test_what_has_to_be_made_in_join_is_refused_in_the_constructor(start) -> None:
    """The refusal comes at the first start, not after the first migration."""
    node = start("makes in constructor", wait=False)
    assert node.process.wait(PATIENCE) == 1
    assert "Brain.__init__ makes a publisher of /early" in node.said()


def test_a_node_that_does_not_answer_is_named(start) -> None:
    """The wait for a node that SIGSTOP has stopped ends in time, with the cause."""
    node = start()
    os.kill(node.pid, signal.SIGSTOP)
    os.waitid(os.P_PID, node.pid, os.WSTOPPED)
    ask_prepare(node.directory, node.pid, "m1")
    with pytest.raises(PortableError, match=f"process {node.pid} is stopped"):
        await_left(node.directory, "m1", 0.2, node.pid)


@pytest.mark.parametrize("away", [False, True])
def test_sigterm_is_an_orderly_end(stage, start, heard, away) -> None:
    """While it runs and while it is away, the exit code is 0, and the control directory is gone."""
    node = start()
    hear_more(stage, heard)
    if away:
        node.prepare("m1")
    node.process.terminate()
    assert node.process.wait(PATIENCE) == 0
    assert read_message(node.directory, Status) is None


def test_a_program_that_exits_has_not_failed(start) -> None:
    """The exit code is its own, and no failure is reported."""
    node = start("exits")
    assert node.process.wait(PATIENCE) == 3
    assert read_message(node.directory, Status) is None


def test_started_by_hand_it_is_an_ordinary_node(stage, start, heard) -> None:
    """Without a control directory it joins, counts, and ends by SIGINT like any node."""
    node = start(wait=False, controlled=False)
    hear_more(stage, heard)
    assert not node.directory.exists()
    node.process.send_signal(signal.SIGINT)
    assert node.process.wait(PATIENCE) == 0
    assert "Traceback" not in node.said()


def test_the_example_finds_its_memory_as_it_was(stage, start) -> None:
    """Before and after a migration the checksum is the same, and no count is missing."""
    example = [sys.executable, "-m", "rosrm_examples.portable_counter", "--mb", "9"]
    heard = stage.listen(Int64MultiArray, "count", 100)
    node = start(command=[*example, "--period", "0.01"])
    stage.spin_until(lambda: heard and heard[-1].data[1] >= 2, "two passes")
    node.prepare("m1")
    passes = heard[-1].data[1]
    assert not node.resume("m1").missing
    stage.spin_until(lambda: heard[-1].data[1] >= passes + 2, "two passes after the move")
    assert {one.data[2] for one in heard if one.data[1]} == {zlib.crc32(filled(9_000_000))}
    counts = [one.data[0] for one in heard]
    assert counts == list(range(counts[0], counts[0] + len(counts))), counts


# --- another address ---

LISTENER = """
import rclpy
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(Int64, "count", lambda message: print(message.data, flush=True), 1000)
rclpy.spin(node)
"""


class Cable:
    """Two network namespaces and a cable between them; they end with their processes."""

    def __init__(self) -> None:
        self._holders = [self._namespace(), self._namespace()]
        self.here, self.there = (("nsenter", "-t", str(one.pid), "-n") for one in self._holders)
        far = str(self._holders[1].pid)
        self._ip(self.here, "link", "add", "e0", "type", "veth", "peer", "name", "e0", "netns", far)
        for side, address in ((self.here, "10.88.0.1/24"), (self.there, "10.88.0.2/24")):
            self._ip(side, "link", "set", "lo", "up")
            self._ip(side, "address", "add", address, "dev", "e0")
            self._ip(side, "link", "set", "e0", "up")
        # The kernel tells of a carrier up to a second later; Fast DDS takes no interface without.
        for side in (self.here, self.there):
            wait_until(lambda side=side: "state UP" in self._ip(side, "link", "show", "e0"), "e0")

    @staticmethod
    def _namespace() -> subprocess.Popen:
        command = ["unshare", "-n", "sh", "-c", "echo on; exec sleep 300"]
        holder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if holder.stdout.readline() != b"on\n":
            pytest.skip(f"no network namespace may be made: {holder.stderr.read().decode()}")
        return holder

    @staticmethod
    def _ip(side: tuple[str, ...], *words: str) -> str:
        done = subprocess.run([*side, "ip", *words], capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"ip {' '.join(words)}: {done.stderr}")
        return done.stdout

    def readdress(self) -> None:
        """The far side is at another address from now on."""
        self._ip(self.there, "address", "flush", "dev", "e0")
        self._ip(self.there, "address", "add", "10.88.0.3/24", "dev", "e0")

    def close(self) -> None:
        for one in self._holders:
            one.kill()
            one.communicate()


@pytest.fixture
def cable():
    cable = Cable()
    yield cable
    cable.close()


def test_a_node_is_heard_at_its_new_address(stage, start, cable, tmp_path) -> None:
    """The address changes while it is away: its listener hears on, and each count once."""
    counts = tmp_path / "counts"
    with counts.open("wb") as file:
        listener = subprocess.Popen(
            [*cable.here, sys.executable, "-c", LISTENER], stdout=file,
            env={**os.environ, "ROS_DOMAIN_ID": str(stage.domain)},
        )  # fmt: skip
    try:
        node = start(words=cable.there)

        def hears(more: int) -> None:
            enough = len(counts.read_text().split()) + more
            stage.spin_until(lambda: len(counts.read_text().split()) >= enough, "counts")

        hears(10)
        node.prepare("m1")
        cable.readdress()
        assert not node.resume("m1").missing
        hears(10)
    finally:
        listener.kill()
        listener.wait()
    found = [int(one) for one in counts.read_text().split()]
    assert found == list(range(found[0], found[0] + len(found)))
