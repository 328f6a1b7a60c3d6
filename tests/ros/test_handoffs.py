"""Handoffs by a real master and real slaves; failures report a clear reason."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
from std_msgs.msg import Int64

from rosrm.model.values import MigrationPolicy, ProcessSpec, Readiness, RestartPolicy
from rosrm_msgs.msg import StateConfig
from tests.cpp.core_library import ROOT, VARIABLE
from tests.ros.clusters import CALM, NODE, alive, host
from tests.ros.nodes import Conductor, Stage
from tests.waiting import PATIENCE, wait_until

#: A counter with a fault: `{fault}` is the end of its constructor, `{node}` imports its base class.
COUNTER = """
import os, sys, rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Int64
{node}

class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.count = 0
        self.output = self.create_publisher(Int64, "~/count", 10)
        self.create_timer(0.02, self.tick)
        self.shadow = "ROSRM_SHADOW" in os.environ
        {fault}

    def tick(self):
        self.count += 1
        self.output.publish(Int64(data=self.count))

    def keep(self, restore=None):
        self.keep_state("~/state", Int64, self.save, restore or self.restore)

    def save(self):
        return Int64(data=self.count)

    def restore(self, state):
        self.count = state.data

rclpy.init()
try:
    rclpy.spin(Counter())
except (KeyboardInterrupt, ExternalShutdownException):
    pass
"""


def spec(name: str, code: str, **options) -> ProcessSpec:
    return ProcessSpec(
        name, command=(sys.executable, "-c", code), ros=True, stop=CALM,
        readiness=Readiness(timeout=PATIENCE),
        migration=MigrationPolicy("handoff", options=options),
        restart=RestartPolicy("on-failure", delay=0.2),
    )  # fmt: skip


PYTHON = "from rosrm.node import Node"


def code(fault: str, node: str = PYTHON) -> str:
    return COUNTER.replace("{fault}", fault).replace("{node}", node)


def counter(name: str, fault: str = "self.keep()", node: str = PYTHON, **options) -> ProcessSpec:
    return spec(name, code(fault, node), **options)


@pytest.fixture(params=["rosrm.node", "rosrm_node_cpp"])
def node(request) -> str:
    """Return the line that imports each implementation of the handoff protocol."""
    if request.param == "rosrm.node":
        return PYTHON
    core = request.getfixturevalue("cpp_core")
    return (
        f"os.environ[{VARIABLE!r}] = {str(core)!r}; sys.path.insert(0, {str(ROOT)!r})\n"
        "from tests.cpp.cpp_node import Node"
    )


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), host("h1"))


def migrate(cluster, name: str):
    """Order a migration and wait for its end; return the row before, and the final event."""
    before = cluster.wait(name, "running")
    cluster.client.migrate(name)
    return before, end_of_migration(cluster, name)


def end_of_migration(cluster, name: str):
    """Wait for the end of a migration, and return its event."""
    ends = wait_until(
        lambda: [one for one in cluster.events(process=name) if one.kind in ("migrated", "stayed")],
        f"the end of the migration of {name}", pause=cluster.client.spin,
    )  # fmt: skip
    return ends[0]


def test_a_node_whose_clock_stands_still_moves(cluster, node) -> None:
    """A node on simulated time without a clock migrates, because rosrm uses another clock."""
    ticks = (
        "from rclpy.clock import Clock, ClockType; clock = Clock(clock_type=ClockType.STEADY_TIME)"
        "; self.create_timer(0.02, self.tick, clock=clock); self.keep()"
    )
    still = counter("still", ticks, node)
    cluster.submit(replace(still, parameters={"use_sim_time": True}))
    _, event = migrate(cluster, "still")
    assert event.kind == "migrated", event.message
    cluster.cancel("still")


@pytest.mark.parametrize(
    ("name", "fault", "message"),
    [
        (
            "unrestorable", "self.keep(restore=lambda state: 1 // 0)",
            "restoring /unrestorable/state raised ZeroDivisionError",
        ),
        ("dying", "self.keep(); self.shadow and sys.exit(3)", "ended on h"),
    ],
)  # fmt: skip
def test_a_move_that_fails_leaves_the_source_running(cluster, name, fault, message, node) -> None:
    """The event has one clear message, and nothing else is left."""
    cluster.submit(counter(name, fault, node))
    before, event = migrate(cluster, name)
    assert event.kind == "stayed"
    assert message in event.message
    after = cluster.wait(name, "running")
    assert (after.host, after.pid, alive(after.pid)) == (before.host, before.pid, True)
    cluster.cancel(name)


def test_a_destination_that_is_never_ready_is_given_up_in_time(cluster):
    """The migration fails within `ready_timeout`, and the message names possible causes.

    Two fail at once: of a node of plain rclpy, and of one whose shadow hangs.
    """
    hangs = code("self.shadow and __import__('time').sleep(60)")
    programs = {"plain": NODE, "hangs": hangs}
    cluster.submit(*(spec(name, code, ready_timeout=2.0) for name, code in programs.items()))
    before = {name: cluster.wait(name, "running") for name in programs}
    for name in programs:
        cluster.client.migrate(name)
    for name, row in before.items():
        event = end_of_migration(cluster, name)
        assert event.kind == "stayed"
        assert "Do they use rosrm.node?" in event.message
        assert event.facts["seconds"] < 2.0 + PATIENCE / 2
        assert cluster.wait(name, "running").pid == row.pid
        assert alive(row.pid)
    cluster.cancel(*programs)


def test_a_foreign_state_config_moves_nothing(cluster) -> None:
    """A node logs that `state_config` messages come without its key, and ignores them."""
    cluster.submit(counter("steady"))
    row = cluster.wait("steady", "running")
    stage = Stage(domain=cluster.domain)
    try:
        counts = stage.listen(Int64, "/steady/count")
        stage.spin_until(lambda: len(counts) > 5, "counts")
        stranger = Conductor(stage, source=row.number, destination=999, name="steady")
        for phase in (StateConfig.SHADOW, StateConfig.SWITCH, StateConfig.TAKE_OVER):
            stranger.say(phase, channel="/strange")
        cluster.wait_for_log("steady", "left alone: it is not of this node's master")
        before = len(counts)
        stage.spin_until(lambda: len(counts) > before + 20, "more counts")
    finally:
        stage.close()
    numbers = [message.data for message in counts]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    cluster.cancel("steady")
