"""Nodes with only the paper's two constraints, moved with their state by `protocol: paper`."""

from __future__ import annotations

import sys

import pytest

from rosrm.config.settings import MigrationSettings
from rosrm.errors import Refused
from rosrm.model.values import MigrationPolicy, ProcessSpec, Readiness, RestartPolicy
from tests.ros.clusters import QUICK, SPIN, host
from tests.waiting import PATIENCE

#: Plain rclpy: publishes its state in every cycle; a shadow starts from a received state.
COUNTER = (
    """
import os, rclpy
from rclpy.node import Node
from std_msgs.msg import Int64
rclpy.init()
node = Node("unnamed")
count = None if os.environ.get("ROSRM_SHADOW") else 0
output = node.create_publisher(Int64, "/counter/state", 1)

def initialise(message):
    global count
    if count is None:
        count = message.data
        print("began with", count, flush=True)

def cycle():
    global count
    if count is not None:
        count += 1
        output.publish(Int64(data=count))

node.create_subscription(Int64, "/counter/state", initialise, 1)
node.create_timer(0.02, cycle)
"""
    + SPIN
)
#: The same, but a shadow subscribes to the state only in the function that `state_config` calls.
CONFIGURED = COUNTER.replace(
    'node.create_subscription(Int64, "/counter/state", initialise, 1)',
    """
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosrm.node.handoff.links import NodeLinks
from rosrm.node.identity import identity_from
from rosrm_msgs.msg import Sealed, StateConfig
identity = identity_from(os.environ)
configs = NodeLinks(identity).configs

def configure(data):
    config = configs.read(data)
    if config is None or (config.phase, config.destination) != (
        StateConfig.SHADOW, identity.instance
    ):
        return
    print("configured with", config.source_node, flush=True)
    node.create_subscription(Int64, "/counter/state", initialise, 1)

node.create_subscription(
    Sealed, identity.state_config, configure,
    QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL), raw=True,
)
""",
)
PAPER = {"protocol": "paper", "state": "/counter/state", "type": "std_msgs/msg/Int64"}


@pytest.fixture(scope="module")
def cluster(make_shared):
    strategies = {"handoff": {"start_timeout": 15.0}}
    return make_shared(
        host("left"), host("right"),
        migration=MigrationSettings(strategies=strategies, automatic=False),
    )  # fmt: skip


def counter(name: str = "counter", program: str = COUNTER, **options: object) -> ProcessSpec:
    return ProcessSpec(
        name, command=(sys.executable, "-c", program), ros=True, stop=QUICK,
        readiness=Readiness(timeout=PATIENCE), restart=RestartPolicy("on-failure"),
        migration=MigrationPolicy("handoff", options={**PAPER, **options}),
    )  # fmt: skip


def test_the_count_continues_there_and_back(cluster):
    """The counter migrates twice; the second time the source has an alias."""
    cluster.submit(counter())
    here = cluster.wait("counter", "running").host
    there = {"left": "right", "right": "left"}[here]
    for times, target in enumerate((there, here), start=1):
        cluster.client.migrate("counter", target)
        cluster.wait("counter", "running", migrations=times, host=target)
        log = cluster.wait_for_log("counter", "began with")
        assert int(log.split("began with")[1].split()[0]) > 10
    cluster.cancel("counter")


def test_a_node_is_initialised_in_the_function_that_state_config_calls(cluster):
    """Constraint (ii) of the paper, by the letter: the master's topic begins the initialisation."""
    cluster.submit(counter(program=CONFIGURED))
    here = cluster.wait("counter", "running").host
    cluster.client.migrate("counter", None)
    cluster.wait_for_event("migrated", process="counter")
    assert cluster.wait("counter", "running", migrations=1).host != here
    log = cluster.wait_for_log("counter", "began with")
    configured, began = (log.index(one) for one in ("configured with /counter", "began with"))
    assert configured < began
    assert int(log.split("began with")[1].split()[0]) > 0
    cluster.cancel("counter")


def test_a_state_below_the_nodes_own_name_is_found_under_an_alias(cluster):
    """`~/state` is the same topic under an alias."""
    private = ProcessSpec(
        "private", command=(sys.executable, "-c", COUNTER.replace("/counter/state", "~/state")),
        ros=True, stop=QUICK, readiness=Readiness(timeout=PATIENCE),
        migration=MigrationPolicy("handoff", options={**PAPER, "state": "/private/state"}),
    )  # fmt: skip
    cluster.submit(private)
    cluster.wait("private", "running")
    cluster.client.migrate("private", None)
    cluster.wait_for_event("migrated", process="private")
    assert "began with" in cluster.wait_for_log("private", "began with")
    cluster.cancel("private")


def test_a_topic_without_a_publisher_undoes_the_migration(cluster):
    """The process stays; the event has the reason from the destination's slave."""
    cluster.submit(counter("lost", state="/wrong/state", ready_timeout=2.0))
    cluster.wait("lost", "running")
    cluster.client.migrate("lost", None)
    event = cluster.wait_for_event("stayed", process="lost")
    assert "no node publishes /wrong/state" in event.message
    cluster.wait("lost", "running")
    cluster.cancel("lost")


def test_invalid_options_are_refused_by_the_master(cluster):
    with pytest.raises(Refused, match="protocol 'mine'; allowed: rosrm, paper"):
        cluster.submit(counter("odd", protocol="mine"))
