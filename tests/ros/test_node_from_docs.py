"""A node written from the guide alone, migrated there and back under load."""

from __future__ import annotations

import sys
import threading
import time
from itertools import groupby, pairwise
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float64, Float64MultiArray, Int64MultiArray
from std_srvs.srv import Trigger

from rosrm.config.settings import MigrationSettings
from rosrm.model.values import MigrationPolicy, ProcessSpec, Readiness
from tests.ros.clusters import host
from tests.waiting import PATIENCE, wait_until

PROGRAM = Path(__file__).parent / "programs" / "dock.py"
DOCK = ProcessSpec(
    "dock",
    command=(sys.executable, str(PROGRAM)),
    ros=True,
    migration=MigrationPolicy(strategy="handoff"),
    parameters={"limit": 500.0},
    readiness=Readiness(timeout=PATIENCE),
)
CHARGE = 100  # of each order: more comes than is delivered, so that `current` shows the limit
ANSWER_TIMEOUT = 3.0  # seconds until a call is given up, which a busy machine may take


class Robots:
    """Clients of the dock in one thread, which order, measure, reserve and listen.

    Attributes:
        current, receipts, health: received messages: time and data.
        answers: of `reserve`, in order.
        unanswered: number of calls given up.
        orders, readings: numbers of messages sent.
    """

    def __init__(self, domain: int) -> None:
        self.current, self.receipts, self.health, self.answers = [], [], [], []
        self.unanswered = self.orders = self.readings = 0
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("robots", context=self.context)
        for topic, kind, heard, qos in (
            ("receipts", Int64MultiArray, self.receipts, 1000),
            ("dock/health", Float64MultiArray, self.health, 10),
            ("current", Float64MultiArray, self.current, qos_profile_sensor_data),
        ):
            self.node.create_subscription(kind, topic, self.listener(heard), qos)
        self.orders_out = self.node.create_publisher(Int64MultiArray, "orders", 1000)
        self.voltage_out = self.node.create_publisher(Float64, "voltage", qos_profile_sensor_data)
        self.client = self.node.create_client(Trigger, "reserve")
        self.parameters = AsyncParameterClient(self.node, "dock")
        self.call, self.called = None, 0.0
        self.timers = []
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin)
        self.thread.start()

    def close(self) -> None:
        self.executor.shutdown()
        self.thread.join()
        self.node.destroy_node()
        self.context.try_shutdown()

    @staticmethod
    def listener(heard: list):
        return lambda message: heard.append((time.monotonic(), list(message.data)))

    # --- load ---

    def begin(self) -> None:
        """Start the load once discovery is complete."""
        wait_until(self.orders_out.get_subscription_count, "the input of orders")
        wait_until(lambda: self.current and self.health, "the dock's outputs")
        wait_until(self.client.service_is_ready, "the service")
        self.timers = [
            self.node.create_timer(0.01, self.order),
            self.node.create_timer(0.007, self.measure),
            self.node.create_timer(0.01, self.reserve),
        ]

    def end(self) -> None:
        """Stop the load, and wait for the outstanding messages."""
        for timer in self.timers:
            timer.cancel()
        wait_until(
            lambda: len(self.receipts) >= self.orders, f"{self.orders} receipts",
            seen=lambda: f"{len(self.receipts)} came",
        )  # fmt: skip
        reports = len(self.health)
        wait_until(lambda: len(self.health) >= reports + 2, "a report of the end")

    def order(self) -> None:
        self.orders += 1
        data = [self.orders, self.orders, CHARGE]
        self.orders_out.publish(Int64MultiArray(data=data))

    def measure(self) -> None:
        self.readings += 1
        self.voltage_out.publish(Float64(data=float(self.readings)))

    def reserve(self) -> None:
        """Keep one call of `reserve` pending."""
        now = time.monotonic()
        if self.call is not None and self.call.done():
            self.answers.append(int(self.call.result().message))
            self.call = None
        elif self.call is not None and now > self.called + ANSWER_TIMEOUT:
            self.client.remove_pending_request(self.call)
            self.call, self.unanswered = None, self.unanswered + 1
        if self.call is None:
            self.call, self.called = self.client.call_async(Trigger.Request()), now

    # --- parameters, set and read as `ros2 param` does ---

    def ask(self, send):
        """Call a parameter service; repeat the call, because the server may have just gone."""
        for _ in range(5):
            future, answered = send(), threading.Event()
            future.add_done_callback(lambda _, answered=answered: answered.set())
            if answered.wait(2.0):
                return future.result()
        raise AssertionError("no parameter service of /dock answers")

    def set_limit(self, limit: float) -> None:
        (result,) = self.ask(
            lambda: self.parameters.set_parameters([Parameter("limit", value=limit)])
        ).results
        assert result.successful, result.reason
        wait_until(lambda: self.current[-1][1][4] == limit, f"a limit of {limit}")

    def limit(self) -> float:
        (value,) = self.ask(lambda: self.parameters.get_parameters(["limit"])).values
        return value.double_value


@pytest.fixture
def cluster(make_cluster):
    """Yield a cluster of two hosts, without automatic migration."""
    settings = MigrationSettings({"handoff": {}}, automatic=False)
    return make_cluster(host("h0"), host("h1"), migration=settings)


@pytest.fixture
def robots(cluster):
    robots = Robots(cluster.domain)
    yield robots
    robots.close()


def move(cluster, robots, to: str, times: int) -> SimpleNamespace:
    """Migrate the dock; return the times of begin and end."""
    began = time.monotonic()
    cluster.client.migrate("dock", to)
    cluster.wait("dock", "running", host=to, migrations=times)
    ended = time.monotonic()
    wait_until(lambda: robots.health[-1][0] > ended + 1.0, f"reports from {to}")
    return SimpleNamespace(began=began, ended=ended)


def names(robots) -> set[str]:
    """Return the dock's topics and services, except the one that rcl creates."""
    found = robots.node.get_topic_names_and_types() + robots.node.get_service_names_and_types()
    mine = {name for name, _ in found if name.startswith("/dock")}
    return {name for name in mine if not name.endswith("/get_type_description")}


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_node_from_the_guide_moves_there_and_back_with_its_state(cluster, robots) -> None:
    """Every order counts once, no number repeats, and a limit set on the way stays."""
    cluster.submit(DOCK)
    home = cluster.wait("dock", "running").host
    away = {"h0": "h1", "h1": "h0"}[home]
    robots.begin()
    before = names(robots)
    assert before >= {"/dock/health", "/dock/set_parameters"}
    robots.set_limit(750.0)
    wait_until(lambda: len(robots.health) > 3, "three reports")

    moves = [move(cluster, robots, away, times=1)]
    assert robots.limit() == 750.0
    assert robots.current[-1][1][1] == 750.0  # the delivered current is at the limit
    assert names(robots) >= before
    assert not [name for name in names(robots) if not name.startswith("/dock/")]
    robots.set_limit(900.0)
    moves.append(move(cluster, robots, home, times=2))
    assert robots.limit() == 900.0
    assert robots.current[-1][1][1] == 900.0
    robots.end()
    assert "Traceback" not in (said := cluster.log("dock")), said
    print(summary(robots, moves))

    # Each order counts once and in order, and both parts of the state agree.
    assert [data for _, data in robots.receipts] == [[n, n, n] for n in counted(robots.orders)]

    # The lossy output shows no second dock.
    current = [data for _, data in robots.current]
    assert all(a[0] < b[0] for a, b in pairwise(current)), "repeated or out of order"
    assert all(a[2] <= b[2] and a[3] <= b[3] for a, b in pairwise(current)), "older readings"
    assert current[-1][3] <= robots.readings
    assert [limit for limit, _ in groupby(data[4] for data in current)] == [500.0, 750.0, 900.0]

    # There is one server at a time, and each continues the count of the former.
    assert all(a < b for a, b in pairwise(robots.answers))
    assert robots.unanswered <= 2 * len(moves)
    reserved = robots.health[-1][1][3]
    assert len(robots.answers) <= reserved <= len(robots.answers) + robots.unanswered + 1

    # The slow timer keeps its period.
    times, reports = zip(*((when, data[0]) for when, data in robots.health), strict=True)
    assert list(reports) == [reports[0] + n for n in range(len(reports))]
    phases = [when - number for number, when in zip(reports, times, strict=True)]
    assert abs(median(phases[-5:]) - median(phases[:5])) < 0.5  # one may be late, of a busy machine


def counted(number: int) -> range:
    return range(1, number + 1)


def summary(robots, moves) -> str:
    """Return the costs of the migrations, which also explain a failure."""
    times = [when for when, _ in robots.current]
    reports = [when for when, _ in robots.health]
    lost = robots.current[-1][1][0] - robots.current[0][1][0] + 1 - len(robots.current)
    return (
        f"moves {[round(move.ended - move.began, 2) for move in moves]} s, "
        f"longest pause {max(b - a for a, b in pairwise(times)):.3f} s, {lost:.0f} lost, "
        f"reports every {min(b - a for a, b in pairwise(reports)):.3f}"
        f"..{max(b - a for a, b in pairwise(reports)):.3f} s, "
        f"{robots.orders} orders, {len(robots.answers)} answers, {robots.unanswered} unanswered, "
        f"{robots.current[-1][1][3]:.0f} of {robots.readings} readings"
    )
