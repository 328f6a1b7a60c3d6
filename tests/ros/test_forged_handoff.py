"""Forged messages about handoffs, sent to the nodes of a real cluster."""

from __future__ import annotations

import pytest
from std_msgs.msg import Int64

from rosrm.ros.qos import HANDOFF
from rosrm_msgs.msg import HandoffReport, StateConfig
from tests.ros.clusters import host
from tests.ros.nodes import Conductor, Stage
from tests.ros.test_handoffs import counter, migrate
from tests.waiting import holds_for, wait_until

R, C = HandoffReport, StateConfig


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), host("h1"))


@pytest.fixture
def stage(cluster):
    stage = Stage(domain=cluster.domain)
    yield stage
    stage.close()


def counts_on(stage, heard, more: int = 10) -> None:
    before = len(heard)
    stage.spin_until(lambda: len(heard) >= before + more, "further counts")


def conductor(cluster, stage, row, destination: int) -> Conductor:
    """Return a stranger that speaks as the master and as the destination of a handoff."""
    forged = Conductor(stage, source=row.number, destination=destination, name=row.name)
    forged.config.cluster, forged.config.epoch = cluster.cluster.name, 1
    return forged


def test_a_node_that_a_stranger_silenced_counts_on_and_can_be_moved(cluster, stage) -> None:
    """The node asks the real master, which lets it resume after 10 s, without a gap."""
    cluster.submit(counter("victim"))
    row = cluster.wait("victim", "running")
    heard = stage.listen(Int64, "/victim/count")
    counts_on(stage, heard)
    forged = conductor(cluster, stage, row, 10**6)
    reports = stage.plain.create_publisher(R, forged.config.channel, HANDOFF)
    for phase in (C.SHADOW, C.SWITCH):
        forged.say(phase)
    for phase in (R.SHADOWING, R.SWITCHING):
        reports.publish(
            R(
                protocol_version=forged.config.protocol_version, destination=10**6,
                instance=10**6, phase=phase,
            )
        )  # fmt: skip
    forged.wait(row.number, R.RELEASED)
    stage.spin_until(lambda: "source_stranded" in cluster.kinds("victim"), "the question")
    counts_on(stage, heard)
    numbers = [one.data for one in heard]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    _, event = migrate(cluster, "victim")
    assert event.kind == "migrated", event.message
    counts_on(stage, heard)
    numbers = [one.data for one in heard]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    cluster.cancel("victim")


def test_a_forged_epoch_makes_no_node_deaf(cluster, stage) -> None:
    """The node believes no epoch that its slave does not know, and follows its master."""
    cluster.submit(counter("listener"))
    row = cluster.wait("listener", "running")
    for epoch in (2, 1000, 2**64 - 1):
        forged = conductor(cluster, stage, row, 10**6 + 1)
        forged.say(C.SHADOW, epoch=epoch)
    stage.spin(0.5)
    _, event = migrate(cluster, "listener")
    assert event.kind == "migrated", event.message
    cluster.cancel("listener")


def test_a_handoff_after_a_restart_of_the_master_is_not_refused(cluster, stage) -> None:
    """The slave notes the new epoch when it registers again."""
    cluster.submit(counter("patient"))
    cluster.wait("patient", "running")
    cluster.restart_master()
    wait_until(lambda: cluster.process("patient").state == "running", "the process")
    holds_for(0.5, lambda: cluster.process("patient").state == "running", "the process")
    _, event = migrate(cluster, "patient")
    assert event.kind == "migrated", event.message
    cluster.cancel("patient")
