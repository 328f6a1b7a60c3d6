"""Capabilities of strategies: probes of hosts, the resulting placement, and executor results."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import pytest

from rosrm.model.orders import StartInstance
from rosrm.model.plan import Commit, Execute, Move, Plan, SetRestart, Start, Stop
from rosrm.model.values import MigrationPolicy, RestartPolicy
from tests.unit.core.cluster import Cluster, process
from tests.unit.core.machine import Machine


class Freezing:
    """Strategy that restores an image of the source at the destination, like `criu`."""

    host_check = "can_freeze"

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        same = source["version"] == destination["version"]
        return "" if same else f"it has version {destination['version']}"

    def propose(self, move: Move) -> Plan:
        here, there, policy = move.source_host, move.destination_host, move.spec.restart
        give_back = SetRestart(move.source, here, policy, 5.0)
        stop_there = Stop(move.destination, there, 5.0)
        return Plan(
            (
                SetRestart(move.source, here, RestartPolicy("never"), 5.0, undo=give_back),
                Execute("freeze", here, {"of": move.source.number}, 5.0),
                Execute("fetch", there, {"for": move.destination.number}, 5.0),
                Start(move.destination, there, 5.0, undo=stop_there, restored=True),
                Commit(),
                SetRestart(move.destination, there, policy, 5.0),
                Stop(move.source, here, 5.0),
            )
        )


def late(_plugin: object, _call: object) -> Any:
    """Stand for a plugin call that exceeded its deadline."""
    raise TimeoutError("late")


class Host:
    """Simulated host with the executors of `Freezing`; records their arguments."""

    def __init__(self, name: str, version: str = "4.2", **fields: Any) -> None:
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.facts: Any = {"version": version}
        results = {
            "can_freeze": lambda: self.facts,
            "freeze": lambda: {"port": 4242},
            "fetch": dict,
        }
        executors = {one: partial(self._execute, one, result) for one, result in results.items()}
        self.machine = Machine(name, executors=executors, **fields)

    def _execute(self, name: str, result: Any, arguments: Mapping[str, Any]) -> Any:
        self.asked.append((name, arguments))
        if isinstance(result(), Exception):
            raise result()
        return result()


def frozen(*hosts: Host | Machine) -> Cluster:
    """Return a cluster with a process that moves by `Freezing`, on the first of these hosts."""
    machines = [host.machine if isinstance(host, Host) else host for host in hosts]
    cluster = Cluster(*machines, strategies={"freezing": Freezing()})
    cluster.submit(process("p", migration=MigrationPolicy("freezing")))
    cluster.wait(1.0)
    assert cluster.where("p") == ["a"]
    return cluster


def busy(name: str, version: str = "4.2") -> Host:
    return Host(name, version, busy={"memory": 0.5})


def test_each_run_of_a_slave_is_probed_once() -> None:
    """The master probes a host after its registration, and again after that of its next slave."""
    host = Host("a")
    cluster = frozen(host)
    cluster.wait(60.0)
    assert host.asked == [("can_freeze", {})]
    host.machine.incarnation += 100
    cluster.cut("a", seconds=1.5)
    cluster.rejoin("a", 2.0)
    assert [name for name, _ in host.asked] == ["can_freeze", "can_freeze"]


@pytest.mark.parametrize("killed", [False, True], ids=["same master", "next master"])
def test_a_process_moves_to_a_host_of_the_same_capability(killed: bool) -> None:
    """The destination gets the image's location from the master, and restores from that image.

    A later step needs the executor's result, whichever run of the master orders that step.
    """
    here, there = Host("a"), busy("b")
    cluster = frozen(here, there)
    number = cluster["p"].owner
    there.machine.connected = not killed
    assert cluster.migrate("p", "b").accepted
    cluster.wait(0.5)
    assert here.asked[-1] == ("freeze", {"of": number})
    if killed:
        cluster.kill_master()
        there.machine.connected = True
        cluster.restart_master()
    cluster.wait(5.0)
    assert (cluster.phase("p"), cluster.where("p")) == ("running", ["b"])
    fetches = [arguments for name, arguments in there.asked if name == "fetch"]
    assert fetches[-1]["results"] == {"freeze": {"port": 4242}}
    assert cluster.orders(StartInstance)[-1].assignment.restored


def test_a_host_without_the_capability_is_no_destination():
    """The reply names the host's own reason."""
    there = busy("b")
    there.facts = RuntimeError("CRIU 3.17 is too old")
    cluster = frozen(Host("a"), there)
    reply = cluster.migrate("p", "b")
    assert not reply.accepted
    assert "freezing does not work on b: CRIU 3.17 is too old" in reply.message
    anywhere = cluster.migrate("p")
    assert anywhere.message == (
        "no host can take p: freezing does not work on b: CRIU 3.17 is too old"
    )
    assert "freezing does not work on b" in " ".join(cluster.recorded("strategy_absent"))


def test_a_host_on_which_the_check_failed_is_checked_again() -> None:
    """A short fault does not exclude the host until its slave restarts; one event records it."""
    there = busy("b")
    there.facts = RuntimeError("no memory left")
    cluster = frozen(Host("a"), there)
    cluster.wait(1500.0, tick=1.0)
    assert len(there.asked) == 3
    assert len(cluster.recorded("strategy_absent")) == 1
    there.facts = {"version": "4.2"}
    cluster.wait(601.0, tick=1.0)
    assert cluster.migrate("p", "b").accepted


def test_hosts_with_another_capability_are_no_destinations():
    """The strategy's own comparison of capabilities decides."""
    cluster = frozen(Host("a"), busy("b", "4.1"), busy("c"))
    reply = cluster.migrate("p", "b")
    assert "it has version 4.1" in reply.message
    assert cluster.migrate("p").accepted
    cluster.wait(2.0)
    assert cluster.where("p") == ["c"]


def test_a_check_that_changes_the_capabilities_changes_its_own_copies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The master keeps what a host has answered once, for each later comparison."""

    def host_fault(_self: object, source: dict[str, str], destination: dict[str, str]) -> str:
        return "" if source.pop("version") == destination.pop("version") else "it differs"

    monkeypatch.setattr(Freezing, "host_fault", host_fault)
    cluster = frozen(Host("a"), busy("b", "4.1"))
    for _ in range(2):
        assert "it differs" in cluster.migrate("p", "b").message


def test_hosts_without_the_plugin_are_no_destinations() -> None:
    """The master does not probe them; a refusal names them together."""
    cluster = frozen(Host("a"), *(Machine(name, busy={"memory": 0.5}) for name in "bcde"))
    assert "is not installed there" in cluster.migrate("p", "b").message
    assert cluster.migrate("p").message == (
        "no host can take p: freezing does not work on b, c and 2 more: "
        "the plugin of 'freezing' is not installed there"
    )


def test_a_strategy_that_fails_to_name_its_host_check_is_called_again():
    """One late plugin call must not exclude the strategy from every host until a slave restarts."""
    host, cluster = Host("a"), Cluster(strategies={"freezing": Freezing()})
    limit, cluster.state.plugins.limit = cluster.state.plugins.limit, late
    cluster.add(host.machine)
    cluster.wait(5.0)
    assert host.asked == []
    cluster.state.plugins.limit = limit
    cluster.wait(10.0)
    assert host.asked == [("can_freeze", {})]
