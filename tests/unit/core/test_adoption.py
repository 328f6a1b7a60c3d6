"""Adoption in the master: the host is given, and no second copy of a program is started."""

from __future__ import annotations

import pytest

from rosrm.model.adoption import NO_ADOPTION, Adoption
from rosrm.model.adoption_rules import adoption_fault
from rosrm.model.orders import StartInstance
from rosrm.model.values import (
    Container,
    HostLossPolicy,
    Kind,
    Limits,
    ProcessSpec,
    StandbyPolicy,
)
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process

ON_A = Adoption("a", 4711, 17, "boot")


def adopted(name: str = "p", **fields) -> ProcessSpec:
    """Return the spec of a process that runs on `a` already."""
    return movable(name, adoption=ON_A, **fields)


def full(name: str) -> Machine:
    """Return a host that is over its limit of memory, and so asks for no work."""
    return Machine(name, memory=1000 * MIB, busy={"memory": 0.95}, takes=False)


def test_an_adopted_process_is_assigned_to_its_host() -> None:
    """The process is there and needs no room: its host is over a limit, and asks for no work."""
    cluster = Cluster(full("a"), "b").with_processes(adopted(memory=500))
    assert cluster.where("p") == ["a"]
    assert cluster.phase("p") == "running"
    (order,) = cluster.orders(StartInstance)
    assert order.assignment.spec.adoption == ON_A


def test_the_journal_has_the_adoption_until_the_process_is_reported() -> None:
    """A master that is killed before knows what to adopt, and afterwards that nothing is left."""
    cluster = Cluster("a")
    cluster.machines["a"].connected = False
    cluster.submit(adopted())
    pending = cluster.intents["process"]["p"]
    assert pending["spec"]["adoption"] == {"host": "a", "pid": 4711, "birth": 17, "boot": "boot"}
    assert pending["phase"] == "assigned"
    cluster.reconnect("a", seconds=0.2)
    assert cluster["p"].spec.adoption == NO_ADOPTION
    assert cluster.intents["process"]["p"]["spec"]["adoption"]["host"] == ""


def test_an_adopted_process_survives_a_restart_of_the_master() -> None:
    """The process is expected on its host, as any other process, and not started twice."""
    cluster = Cluster("a", "b").with_processes(adopted())
    cluster.restart_master()
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["a"])
    assert len(cluster.orders(StartInstance)) == 1


def test_the_first_move_starts_the_program() -> None:
    """The destination gets a spec that adopts nothing."""
    cluster = Cluster("a", "b").with_processes(adopted())
    assert cluster.migrate("p", "b").accepted
    cluster.wait(1.0)
    assert cluster.where("p") == ["b"]
    assert cluster.orders(StartInstance)[-1].assignment.spec.adoption == NO_ADOPTION


def test_a_process_that_is_not_adopted_fails() -> None:
    """The program may still run, so only a request starts it again."""
    cluster = Cluster(Machine("a", refuses={"p": "process 4711 is not adopted: it has ended"}), "b")
    cluster.submit(adopted())
    cluster.wait(1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])
    assert cluster["p"].reason == "process 4711 is not adopted: it has ended"
    cluster.machines["a"].refuses.clear()
    assert cluster.restart("p").accepted
    assert (cluster.phase("p"), cluster["p"].spec.adoption) == ("running", NO_ADOPTION)


def test_a_host_that_is_lost_before_the_adoption_fails_it() -> None:
    """No other host can adopt the process, also if it may be started elsewhere later."""
    cluster = Cluster("a", "b")
    cluster.machines["a"].connected = False
    cluster.submit(adopted(host_loss=HostLossPolicy("elsewhere")))
    cluster.wait(60.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("failed", [])


def test_a_cancelled_adoption_leaves_the_process_alone() -> None:
    """A later restart starts the program, and adopts nothing."""
    cluster = Cluster("a")
    cluster.machines["a"].connected = False
    cluster.submit(adopted())
    cluster.cancel("p")
    cluster.reconnect("a", seconds=1.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("cancelled", [])
    assert cluster["p"].spec.adoption == NO_ADOPTION


def test_an_adoption_names_a_host_that_reports() -> None:
    """Nothing is queued for an unknown host, or one that is away."""
    cluster = Cluster("a", "b")
    reply = cluster.submit(process("p", adoption=Adoption("c", 4711, 17, "boot")))
    assert (reply.accepted, reply.code) == (False, "unknown")
    assert "no such host: 'c'" in reply.message
    cluster.cut("a", seconds=60.0)
    reply = cluster.submit(adopted())
    assert reply.message == "process 4711 of a is not adopted: a is lost"
    assert not cluster.state.processes


def test_an_instance_is_not_adopted() -> None:
    """The master knows the pids of its instances."""
    cluster = Cluster("a").with_processes(process("p"))
    pid = next(iter(cluster.state.instances.values())).pid
    reply = cluster.submit(process("q", adoption=Adoption("a", pid, 17, "boot")))
    assert reply.message == f"process {pid} of a is not adopted: it is the process p already"


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"adoption": Adoption("a", 1, 17, "b")}, "adoption: pid 1 cannot be adopted; allowed: 2 "),
        ({"adoption": Adoption("a", 0, 17, "b")}, "adoption: pid 0 cannot be adopted; allowed: 2 "),
        ({"adoption": Adoption("a", 2**31, 17, "b")}, "pid 2147483648 cannot be adopted"),
        ({"adoption": Adoption("a", 4711, 17, "")}, "adoption: the id of the boot is missing"),
        ({"adoption": Adoption("a b", 4711, 17, "b")}, "adoption: 'a b'"),
        ({"kind": Kind.JOB}, "a running process cannot be adopted with kind: job"),
        ({"container": Container("ros:jazzy", "podman")}, "cannot be adopted with container"),
        ({"standby": StandbyPolicy(wanted=True)}, "cannot be adopted with standby"),
        ({"together": "swarm"}, "cannot be adopted with together"),
        ({"application": "nav", "secrets": {"T": "/t"}}, "adopted with secrets and app"),
        ({"limits": Limits(memory=1e9, enforce="required")}, "with limits.enforce: required"),
    ],
)
def test_an_adoption_that_cannot_be_is_refused(fields, said) -> None:
    """Some settings take effect at a start alone, which is over for a process that runs."""
    assert said in adoption_fault(process("p", **{"adoption": ON_A, **fields}))


def test_defaults_of_the_cluster_can_refuse_an_adoption() -> None:
    """The refusal names the field, which no client has given."""
    defaults = ProcessSpec(
        "default", package="any", executable="any", given=("limits.memory", "limits.enforce"),
        limits=Limits(memory=1e9, enforce="required"),
    )  # fmt: skip
    cluster = Cluster("a", process_defaults=defaults)
    reply = cluster.submit(adopted())
    assert "p: a running process cannot be adopted with limits.enforce: required" in reply.message
