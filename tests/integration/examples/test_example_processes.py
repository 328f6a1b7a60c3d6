"""The examples as real processes: the ROS 2 mapping nodes, and the memory holder."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosrm.testing.local_cluster import claim_domain
from rosrm_examples.pieces import load_piece
from tests.waiting import PATIENCE, wait_until

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def domain() -> Iterator[int]:
    """Claim a ROS domain that no other test on this machine uses."""
    number, claim = claim_domain()
    with claim:
        yield number


@pytest.fixture
def start(domain: int) -> Iterator[Start]:
    """Yield a function that starts example modules; end the remaining ones afterwards."""
    started: list[subprocess.Popen[str]] = []
    environment = {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain),
    }

    def start_module(module: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", f"rosrm_examples.{module}", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        started.append(process)
        return process

    yield start_module
    for process in started:
        process.send_signal(signal.SIGINT)  # a node that is killed leaves its shared memory
    for process in started:
        try:
            process.communicate(timeout=20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


class Listener:
    """A ROS node that receives odometry and lists the nodes of the graph."""

    def __init__(self, topic: str, domain: int) -> None:
        rclpy = pytest.importorskip("rclpy")
        from nav_msgs.msg import Odometry

        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("listener", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.messages: list[Odometry] = []
        self._subscription = self._node.create_subscription(
            Odometry, topic, self.messages.append, 100
        )

    def is_matched(self) -> bool:
        """Return True if a publisher is discovered; earlier messages do not arrive."""
        return bool(self._subscription.get_publisher_count())

    def wait_for(self, count: int) -> None:
        """Wait until `count` messages have arrived."""
        wait_until(
            lambda: len(self.messages) >= count,
            f"{count} messages",
            seen=lambda: len(self.messages),
            pause=lambda seconds: self._executor.spin_once(timeout_sec=seconds),
        )

    def sees(self, name: str) -> bool:
        """Return True if a node of this name is in the graph."""
        return name in self._node.get_node_names()

    def close(self) -> None:
        self._executor.shutdown()
        self._context.shutdown()


@pytest.fixture
def listen(domain: int) -> Iterator[Callable[[str], Listener]]:
    """Yield a function that creates listeners, which must exist before their publishers."""
    made: list[Listener] = []

    def make(topic: str) -> Listener:
        made.append(Listener(topic, domain))
        return made[-1]

    yield make
    for one in made:
        one.close()


def peak_mb(process: subprocess.Popen[str]) -> float:
    """Wait for a process to end; return the highest private memory seen, in MB."""
    peak = 0.0
    while process.poll() is None:
        peak = max(peak, resident_mb(process))
        time.sleep(0.01)
    return peak


def resident_mb(process: subprocess.Popen[str]) -> float:
    """Return the private resident memory of a process, in MB."""
    pages = Path(f"/proc/{process.pid}/statm").read_text().split()
    return (int(pages[1]) - int(pages[2])) * os.sysconf("SC_PAGESIZE") / 1e6


def test_map_piece_maps_its_piece(start: Start, tmp_path: Path) -> None:
    """The node writes its piece, prints its progress, and exits with 0."""
    pytest.importorskip("rclpy")
    arguments = ["--drive", "street:30", "--piece", "2", "--of", "2", "--out", str(tmp_path)]
    node = start("map_piece", *arguments, "--ros-args", "-r", "__node:=mapper")
    output, errors = node.communicate(timeout=PATIENCE)
    assert (node.returncode, errors) == (0, "")
    assert "10/15 scans" in output
    assert "15/15 scans" in output
    assert load_piece(tmp_path / "piece_02.npz").indices.tolist() == list(range(15, 30))


def test_map_piece_publishes_the_pose_of_every_scan(start: Start, listen, tmp_path: Path) -> None:
    """A subscriber gets the scans' odometry in order, with the pose and a plausible velocity."""
    listener = listen("/car/odometry")
    arguments = ["--drive", "street:150", "--piece", "1", "--of", "1", "--out", str(tmp_path)]
    start("map_piece", *arguments, "--rate", "10", "--ros-args", "-r", "__ns:=/car")
    listener.wait_for(5)
    messages = listener.messages
    tenths = [round(m.header.stamp.sec * 10 + m.header.stamp.nanosec / 1e8) for m in messages]
    assert tenths == list(range(tenths[0], tenths[0] + len(messages)))
    travelled = [message.pose.pose.position.x for message in messages]
    assert travelled == sorted(travelled)
    assert 8 < messages[-1].twist.twist.linear.x < 14


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_map_piece_stops_cleanly(start: Start, tmp_path: Path, stop: signal.Signals) -> None:
    """A signal ends the node without a traceback, without a file, and not as a success."""
    pytest.importorskip("rclpy")
    arguments = ["--drive", "street:100", "--piece", "1", "--of", "1", "--out", str(tmp_path)]
    node = start("map_piece", *arguments, "--rate", "20")
    assert node.stdout is not None
    node.stdout.readline()
    node.send_signal(stop)
    output, errors = node.communicate(timeout=PATIENCE)
    assert (node.returncode, errors) == (128 + stop, "")
    assert f"stopped by {stop.name}" in output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        ("map_piece --drive street:30 --piece 3 --of 2 --out {out}", 2,
         "map_piece: piece 3 of 2: pieces are numbered from 1 to 2"),
        ("slam_node --ros-args -p state:=half", 2,
         "slam_node: parameter state: 'half'; allowed are full, pose"),
        *((f"holder --mb {size}", 2, f".*argument --mb: {size} is not a number from 0.*")
          for size in ("-5", "much", "nan", "inf")),
        ("holder --mb 1e12", 1, "holder: no more memory to be had: .*"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_one_line(start: Start, tmp_path: Path, words, code, error) -> None:
    """The error names the argument and what is allowed, after the usage of a plain program."""
    pytest.importorskip("rclpy")
    process = start(*words.format(out=tmp_path).split())
    _, errors = process.communicate(timeout=PATIENCE)
    usage, _, line = errors.rstrip("\n").rpartition("\n")
    assert re.fullmatch(error, line)
    assert (process.returncode, usage[:6]) == (code, "usage:" if "argument" in line else "")


@pytest.mark.parametrize("state", ["full", "pose"])
def test_a_played_drive_is_mapped_as_one_that_is_read(
    start: Start, listen, tmp_path: Path, state: str
) -> None:
    """Player and SLAM without rosrm give the same poses and map as a read drive, bit for bit."""
    listener = listen("/odometry")
    from rosrm_examples.drives import load_drive
    from rosrm_examples.map_part import load_parts
    from rosrm_examples.migration_results import unmigrated_poses

    parameters = ["-p", f"state:={state}", "-p", f"out:={tmp_path / 'parts'}"]
    slam = start("slam_node", "--ros-args", *parameters)
    wait_until(listener.is_matched, "the node's publisher")
    report = tmp_path / "report.json"
    player = start("player", "--drive", "street:20", "--hz", "25", "--report", str(report))
    output, errors = player.communicate(timeout=PATIENCE)
    assert (player.returncode, errors) == (0, "")
    assert "10/20 scans" in output
    assert "sent 20 of 20 scans" in output
    assert json.loads(report.read_text()) == {"scans_sent": 20}
    listener.wait_for(20)  # a scan is mapped before its pose is published
    slam.send_signal(signal.SIGINT)
    output, errors = slam.communicate(timeout=PATIENCE)
    assert (slam.returncode, errors) == (0, "")
    # Fast DDS may have printed a message about its shared memory before.
    assert output.endswith(f"wrote {tmp_path / 'parts' / 'slam.npz'}\n")
    (part,) = load_parts(tmp_path / "parts")
    assert part.poses.tolist() == unmigrated_poses(load_drive("street:20")).tolist()


def test_a_player_waits_for_its_listeners_and_not_for_ever(start: Start) -> None:
    """The player names the missing subscribers after its timeout; a signal ends it, too."""
    pytest.importorskip("rclpy")
    player = start("player", "--drive", "street:3", "--wait", "0.3")
    output, errors = player.communicate(timeout=PATIENCE)
    assert (player.returncode, output) == (1, "sent 0 of 3 scans\n")
    assert errors == "player: 0 of 1 subscribers of /points came within 0.3 s\n"
    player = start("player", "--drive", "street:300", "--subscribers", "0", "--hz", "50")
    assert player.stdout is not None
    player.stdout.readline()
    player.send_signal(signal.SIGTERM)
    output, errors = player.communicate(timeout=PATIENCE)
    assert (player.returncode, errors) == (128 + signal.SIGTERM, "")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_holder_holds_its_memory_until_a_signal(start: Start, stop: signal.Signals) -> None:
    """The process holds 60 MB more than an empty holder, and a signal ends it with 0."""
    empty, full = start("holder", "--mb", "0"), start("holder", "--mb", "60")
    wait_until(lambda: abs(resident_mb(full) - resident_mb(empty) - 60) < 3, "60 MB")
    full.send_signal(stop)
    assert (full.wait(timeout=PATIENCE), full.communicate()) == (0, ("", ""))


def test_holder_grows_and_ends_by_itself(start: Start) -> None:
    """Memory grows at the requested rate, and the process ends with 0 after its time."""
    process = start("holder", "--mb", "10", "--grow", "40", "--seconds", "1.5")
    wait_until(lambda: resident_mb(process) > 45, "45 MB")
    assert (process.wait(timeout=PATIENCE), process.communicate()) == (0, ("", ""))


def test_holder_grows_up_to_its_most(start: Start) -> None:
    """The process grows to `--most`, holds that, and never has more."""
    empty = start("holder", "--mb", "0", "--seconds", "0.5")
    process = start("holder", "--mb", "10", "--grow", "100", "--most", "40", "--seconds", "1.5")
    least = peak_mb(empty)
    assert peak_mb(process) - least == pytest.approx(40, abs=3)


def test_holder_is_small_without_ros() -> None:
    """Neither numpy nor rclpy is loaded for a plain holder."""
    code = (
        "import sys, rosrm_examples.holder as holder\n"
        "assert holder.main(['--mb', '1', '--seconds', '0']) == 0\n"
        "assert not {'numpy', 'rclpy'} & set(sys.modules), 'too much is loaded'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=20)


def test_holder_can_be_a_ros_node(start: Start, listen) -> None:
    """With --ros it is in the ROS graph, takes remappings, and still stops by a signal with 0."""
    listener = listen("/nothing")
    process = start("holder", "--mb", "5", "--ros", "--ros-args", "-r", "__node:=h1")
    wait_until(lambda: listener.sees("h1"), "the node in the graph")
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, output, errors) == (0, "", "")
