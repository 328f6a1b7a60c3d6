"""Orders of a handoff to a real slave: another restart policy, and readiness."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm import clocks
from rosrm.model.orders import StartInstance
from rosrm.model.values import Assignment, InstanceId, ProcessSpec, RestartPolicy
from rosrm.ros import convert, names
from rosrm.ros.orders import start_to_msg
from rosrm.ros.participant import Participant
from rosrm_msgs import srv
from tests.ros.clusters import NODE, host, node, service
from tests.ros.members import path, play_master
from tests.waiting import wait_gone

NEVER = RestartPolicy("never")
ON_FAILURE = RestartPolicy("on-failure", delay=0.05)
#: Of the orders; newer than that of the master.
EPOCH = 1 << 40


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"))


class Orders:
    """A sender of orders beside the master, on the slave's machine and so with its clock."""

    def __init__(self, participant: Participant) -> None:
        self._master = play_master(participant, "h0")

    def set_restart(self, instance: InstanceId, restart: RestartPolicy):
        """Order another restart policy; return the answer."""
        return self._ask(
            srv.ControlHost.Request(
                action=srv.ControlHost.Request.AMEND,
                instance=convert.instance_to_msg(instance), restart=convert.restart_to_msg(restart),
            )
        )  # fmt: skip

    def start(self, assignment: Assignment):
        """Order the start of an instance; return the answer."""
        return self._ask(start_to_msg(StartInstance(assignment), journal=0))

    def _ask(self, request: srv.ControlHost.Request):
        request.envelope = self._master.control.envelope(clocks.boot_time_ns(), EPOCH)
        return self._master.ask(srv.ControlHost, path.of_host("h0", names.CONTROL), request).answer


@pytest.fixture
def orders(cluster):
    with Participant(cluster.ros, "orders") as participant:
        yield Orders(participant)


def end(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    wait_gone(pid)


def test_another_policy_applies_from_its_answer_on(cluster, orders) -> None:
    """An acknowledged policy applies, whatever is killed a moment later."""
    cluster.submit(service("source", restart=ON_FAILURE), service("copy"))
    for name in ("source", "copy"):
        cluster.wait(name, "running")
    rows = {name: cluster.process(name) for name in ("source", "copy")}
    for name, restart in (("source", NEVER), ("copy", ON_FAILURE)):
        answer = orders.set_restart(InstanceId(name, rows[name].number), restart)
        assert answer.accepted, answer.message
    os.kill(cluster.supervisor("h0"), signal.SIGKILL)
    for row in rows.values():
        end(row.pid)
    assert cluster.wait("source", "failed", "finished").state == "failed"
    cluster.wait("copy", "running", restarts=1)
    again = orders.set_restart(InstanceId("source", rows["source"].number), ON_FAILURE)
    assert (again.accepted, again.code) == (False, "ended")
    cluster.cancel("copy")


def test_a_policy_for_a_process_of_a_killed_slave(cluster, orders) -> None:
    """The next slave changes the policy, although it does not know the spec."""
    cluster.submit(service("left", restart=ON_FAILURE))
    row = cluster.wait("left", "running")
    cluster.start_slave_again("h0")
    cluster.wait("left", "running")
    answer = orders.set_restart(InstanceId("left", row.number), NEVER)
    assert answer.accepted, answer.message
    end(row.pid)
    assert cluster.wait("left", "failed").restarts == 0


def test_a_policy_for_an_unknown_instance_is_refused(orders) -> None:
    """The refusal has a code for programs and a reason for users."""
    answer = orders.set_restart(InstanceId("nobody", 99), NEVER)
    assert (answer.accepted, answer.code) == (False, "unknown")
    assert "nobody#99 is not known here" in answer.message


def test_an_order_to_start_is_acknowledged(orders) -> None:
    """The slave answers after the launch, and a repetition that launches nothing, too."""
    spec = ProcessSpec("ordered", command=("true",))
    for _ in range(2):
        answer = orders.start(Assignment(InstanceId("ordered", 99), spec, EPOCH, "ordered"))
        assert answer.accepted, answer.message


def test_readiness_over_kills_of_the_slave(cluster, tmp_path) -> None:
    """The next slave waits for readiness; the one after that knows that the node was ready."""
    go = tmp_path / "go"
    waits = f"import os, time\nwhile not os.path.exists({str(go)!r}): time.sleep(0.05)\n"
    cluster.submit(node("late", waits + NODE))
    pid = cluster.wait("late", "starting").pid
    cluster.start_slave_again("h0")
    cluster.stays(
        1.0, lambda: cluster.process("late").state in ("starting", "unreachable"), "not ready"
    )
    go.touch()
    assert cluster.wait("late", "running").pid == pid
    cluster.start_slave_again("h0")
    assert cluster.wait("late", "running").pid == pid
    cluster.cancel("late")
