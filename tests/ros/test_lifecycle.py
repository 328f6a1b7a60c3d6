"""Lifecycle nodes: real nodes of rclpy are activated by their slave, and moved between hosts."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rosrm.model.values import LifecyclePolicy, MigrationPolicy, ProcessSpec, RestartPolicy
from tests.ros.clusters import SPIN, alive, left_and_right, node
from tests.waiting import PATIENCE, wait_gone

AGAIN = RestartPolicy("on-failure", delay=0.2)
MOVES = MigrationPolicy("lifecycle_node")
#: Seconds between the two transitions of a move: far more than they take on a busy machine, and
#: less than the start of a node.
SHORT = 1.0

#: A lifecycle node that prints its transitions. `fails`: name of a transition that fails; `hangs`:
#: of one that never ends. `notes`: file for the pid, the transition and its time; `home`: file with
#: the name of the host on which `fails` does not apply; nothing fails before the file exists.
MANAGED = (
    """
import os, time, rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

class Managed(LifecycleNode):
    def __init__(self):
        super().__init__("unnamed")
        self.fails = self.declare_parameter("fails", "").value
        self.hangs = self.declare_parameter("hangs", "").value
        self.notes = self.declare_parameter("notes", "").value
        self.home = self.declare_parameter("home", "").value

    def go(self, transition):
        print(transition, flush=True)
        if self.notes:
            with open(self.notes, "a") as notes:
                notes.write(f"{os.getpid()} {transition} {time.monotonic()}\\n")
        while self.hangs == transition:
            time.sleep(0.1)
        home = open(self.home).read() if os.path.exists(self.home) else ""
        failed = self.fails == transition and (home or not self.home)
        failed = failed and home != os.environ["ROSRM_HOST"]
        return TransitionCallbackReturn.FAILURE if failed else TransitionCallbackReturn.SUCCESS

    def on_configure(self, state):
        return self.go("configure")

    def on_activate(self, state):
        return self.go("activate")

    def on_deactivate(self, state):
        return self.go("deactivate")

rclpy.init()
node = Managed()
"""
    + SPIN
)


@pytest.fixture(scope="module")
def cluster(make_shared):
    return left_and_right(make_shared)


def managed(name: str, autostart="active", timeout: float = PATIENCE, **options) -> ProcessSpec:
    """Return a lifecycle node that its slave brings to a state."""
    return node(name, MANAGED, lifecycle=LifecyclePolicy(autostart, timeout), **options)


def printed(cluster, name: str) -> list[str]:
    """Return the lines that the process has printed in all its runs."""
    return [line for line in cluster.log(name).splitlines() if line in ("configure", "activate")]


def test_a_node_is_activated_after_its_start_and_after_each_restart(cluster) -> None:
    """The process is running only when its node is active, also after SIGKILL."""
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


# --- moves ------------------------------------------------------------------------------------


def noted(notes: Path) -> list[tuple[int, str, float]]:
    """Return pid, transition and time of all transitions, in order."""
    lines = [line.split() for line in notes.read_text().splitlines()]
    return [(int(pid), transition, float(at)) for pid, transition, at in lines]


def test_a_node_moves_with_a_short_gap(cluster, tmp_path) -> None:
    """The steps are: configure there, deactivate here, activate there; also by a drain."""
    notes = tmp_path / "notes"
    parameters = {"notes": str(notes)}
    cluster.submit(managed("walker", parameters=parameters, migration=MOVES, restart=AGAIN))
    before = cluster.wait("walker", "running")
    for moves, cause in ((1, "order"), (2, "drain")):
        if cause == "order":
            cluster.client.migrate("walker")
        else:
            cluster.client.set_host_state(before.host, "drain")
        after = cluster.wait("walker", "running", migrations=moves)
        assert after.host != before.host
        wait_gone(before.pid)
        first, second, third = noted(notes)[-3:]
        assert (first[:2], second[:2]) == ((after.pid, "configure"), (before.pid, "deactivate"))
        assert third[:2] == (after.pid, "activate")
        assert third[2] - second[2] < SHORT
        drained, before = before.host, after
    cluster.client.set_host_state(drained, "uncordon")
    cluster.cancel("walker")


def test_a_moved_node_is_activated_after_a_restart(cluster) -> None:
    """The goal of the destination is `active` from the move on."""
    cluster.submit(managed("runner", migration=MOVES, restart=AGAIN))
    before = cluster.wait("runner", "running")
    cluster.client.migrate("runner")
    after = cluster.wait("runner", "running", migrations=1)
    wait_gone(before.pid)
    os.kill(after.pid, signal.SIGKILL)
    cluster.wait("runner", "running", restarts=1)
    assert printed(cluster, "runner") == ["configure", "activate"] * 2
    cluster.cancel("runner")


def test_a_move_goes_back_if_the_destination_cannot_be_activated(cluster, tmp_path) -> None:
    """The destination ends first; then the source is activated again, without a restart."""
    notes, home = tmp_path / "notes", tmp_path / "home"
    parameters = {"notes": str(notes), "home": str(home), "fails": "activate"}
    cluster.submit(managed("stayer", parameters=parameters, migration=MOVES, restart=AGAIN))
    before = cluster.wait("stayer", "running")
    home.write_text(before.host)
    cluster.client.migrate("stayer")
    event = cluster.wait_for_event("stayed", "activate from the state inactive", process="stayer")
    row = cluster.wait("stayer", "running")
    assert (row.host, row.pid, row.migrations) == (before.host, before.pid, 0), event.message
    deactivated, refused, activated = noted(notes)[-3:]
    assert (deactivated[0], activated[0]) == (before.pid, before.pid)
    assert [one[1] for one in (deactivated, refused, activated)] == [
        "deactivate", "activate", "activate",
    ]  # fmt: skip
    assert not alive(refused[0])
    cluster.cancel("stayer")
