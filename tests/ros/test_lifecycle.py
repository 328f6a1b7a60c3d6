"""Lifecycle nodes: real nodes of rclpy are activated by their slave, and moved between hosts."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm.model.values import LifecyclePolicy, ProcessSpec, RestartPolicy
from tests.ros.clusters import SPIN, alive, host, node
from tests.waiting import PATIENCE

AGAIN = RestartPolicy("on-failure", delay=0.2)

#: A lifecycle node that prints its transitions. `fails`: name of a transition that fails; `hangs`:
#: of one that never ends.
MANAGED = (
    """
import time, rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

class Managed(LifecycleNode):
    def __init__(self):
        super().__init__("unnamed")
        self.fails = self.declare_parameter("fails", "").value
        self.hangs = self.declare_parameter("hangs", "").value

    def go(self, transition):
        print(transition, flush=True)
        while self.hangs == transition:
            time.sleep(0.1)
        failed = self.fails == transition
        return TransitionCallbackReturn.FAILURE if failed else TransitionCallbackReturn.SUCCESS

    def on_configure(self, state):
        return self.go("configure")

    def on_activate(self, state):
        return self.go("activate")

rclpy.init()
node = Managed()
"""
    + SPIN
)


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Yield a cluster of one host."""
    return make_shared(host("h0"))


def managed(name: str, autostart="active", timeout: float = PATIENCE, **options) -> ProcessSpec:
    """Return a lifecycle node that its slave brings to a state."""
    return node(name, MANAGED, lifecycle=LifecyclePolicy(autostart, timeout), **options)


def printed(cluster, name: str) -> list[str]:
    """Return the lines that the process has printed in all its runs."""
    return [line for line in cluster.log(name).splitlines() if line in ("configure", "activate")]


def test_a_node_is_activated_after_its_start_and_after_each_restart(cluster) -> None:
    """It counts as running only when it is active, also after SIGKILL."""
    cluster.submit(managed("driver", namespace="/robot", restart=AGAIN))
    before = cluster.wait("driver", "running")
    assert printed(cluster, "driver") == ["configure", "activate"]
    os.kill(before.pid, signal.SIGKILL)
    after = cluster.wait("driver", "running", restarts=1)
    assert after.pid != before.pid
    assert printed(cluster, "driver") == ["configure", "activate"] * 2
    cluster.cancel("driver")


def test_a_node_is_only_configured(cluster) -> None:
    """`autostart: inactive` leaves the activation to another program."""
    cluster.submit(managed("lazy", "inactive"))
    cluster.wait("lazy", "running")
    assert printed(cluster, "lazy") == ["configure"]
    cluster.cancel("lazy")


@pytest.mark.parametrize(
    ("name", "parameters", "timeout", "reason"),
    [
        (
            "unable", {"fails": "configure"}, PATIENCE,
            "the lifecycle transition configure from the state unconfigured failed in the node",
        ),
        (
            "hung", {"hangs": "activate"}, 2.0,
            "the lifecycle transition activate took longer than 2 s",
        ),
    ],
)  # fmt: skip
def test_a_transition_that_fails_or_hangs(cluster, name, parameters, timeout, reason) -> None:
    """The run has failed with the reason, and the process is ended."""
    cluster.submit(managed(name, timeout=timeout, parameters=parameters))
    row = cluster.ended(name)
    assert (row.state, row.reason) == ("failed", f"not ready: {reason}")
    assert not alive(row.pid)
