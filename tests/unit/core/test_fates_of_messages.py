"""Each message between master and slaves meets each fate, one per run: lost, late, twice and so on.

A scenario runs once undisturbed, and then once for each message and fate. After each step the
invariants of the core hold, no process runs too often, and no finished job begins again. At the
end nothing is under way, and the outcome is that of the undisturbed run.

By default each scenario takes a fixed sample of these runs. `ROSRM_FATES=all` takes all of them,
which is about two minutes of CPU time.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import Any

import pytest

from rosrm.model.values import (
    Kind,
    LifecyclePolicy,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
    StartOrder,
)
from tests.unit.core.cluster import job, node, process
from tests.unit.core.three_cores import FATES, Fate, ThreeCores

#: Runs of a scenario in the short form.
SAMPLE = 30
#: Seconds within which a scenario ends after its last command, whatever befalls its messages.
PATIENCE = 150.0
ON_FAILURE = RestartPolicy("on-failure")

Act = Callable[[ThreeCores], object]


@dataclass(frozen=True)
class Scenario:
    """Commands of users and ends of processes.

    Attributes:
        act: its messages meet their fates.
        before: its messages do not.
        seconds: time after `act` in which all happens if nothing is lost.
    """

    act: Act
    before: Act = lambda _: None
    seconds: float = 12.0
    hosts: str = "ab"

    def play(self, fault: tuple[int, Fate] | None = None) -> ThreeCores:
        """Play the scenario until its last command has taken effect."""
        cluster = ThreeCores(self.hosts)
        cluster.wait(1.0)
        self.before(cluster)
        cluster.wait(5.0)
        number, fate = fault or (-1, "lost")
        cluster.disturb(lambda sent, _: fate if sent == number else "")
        self.act(cluster)
        cluster.wait(self.seconds)
        return cluster


def service(
    name: str, strategy: str | None = None, *, version: str = "v1", **fields: Any
) -> ProcessSpec:
    """Return the spec of a node that runs on."""
    overlap = fields.pop("overlap", True)
    moves = MigrationPolicy(strategy, overlap=overlap)
    return node(name, command=(version,), migration=moves, restart=ON_FAILURE, **fields)


def start_restart_cancel(cluster: ThreeCores) -> None:
    cluster.submit(service("p"), job("j", 100, command=("v1", "3", "0")))
    cluster.wait(2.0)
    cluster.restart("p")
    cluster.wait(4.0)
    cluster.cancel("p")


def submit(spec: ProcessSpec) -> Act:
    """Return the act that submits a process."""
    return lambda cluster: cluster.submit(spec)


def move(strategy: str, **fields: Any) -> Scenario:
    """Return the scenario of a move."""
    return Scenario(lambda cluster: cluster.migrate("p"), submit(service("p", strategy, **fields)))


def end_primary(cluster: ThreeCores) -> None:
    """Let the primary crash."""
    cluster.wait(1.0)
    owner = cluster.state.instances[cluster["p"].owner]
    host = next(host for host in cluster.hosts if host.name == owner.host.name)
    host.exit(owner.id, host.programs[owner.id].pid, code=3)


def run_gang(cluster: ThreeCores) -> None:
    """Run two jobs that start together, and a service that restarts with another one."""
    # A job that ends while its supervisor is dead counts as failed, so none ends after a message.
    pair = [
        process(name, 9000, command=("v1", "4.5", "0"), kind=Kind.JOB, together="g")
        for name in ("g1", "g2")
    ]
    follows = StartOrder({"d": "ready"}, 0.0, "restart")
    cluster.submit(*pair, service("d"), service("e", start_order=follows))
    cluster.wait(3.0)
    cluster.restart("d")
    cluster.wait(8.0)
    cluster.cancel("d", "e")


def version(number: str, *, crashes: bool = False) -> Act:
    """Return the act that requests a version of an application."""
    end = ("1", "3") if crashes else ()
    parts = [
        process("s", 100, command=(number,)),
        service("r", "relaunch", version=number),
        replace(service("h", "handoff"), command=(number, *end)),
    ]
    return lambda cluster: cluster.apply("app", *parts, healthy_for=2.0)


STANDBY = service("p", "handoff", standby=StandbyPolicy(wanted=True))
SCENARIOS = {
    "start, restart, cancel": Scenario(start_restart_cancel),
    "relaunch": move("relaunch"),
    "relaunch without overlap": move("relaunch", overlap=False),
    "handoff": move("handoff"),
    "criu": move("criu"),
    "lifecycle_node": move("lifecycle_node", lifecycle=LifecyclePolicy("active", 5.0)),
    "standby takes over": Scenario(end_primary, submit(STANDBY), 20.0, "abc"),
    "standby starts": Scenario(submit(STANDBY), hosts="abc"),
    "gang and dependants": Scenario(run_gang),
    "new version": Scenario(version("v2"), version("v1"), 15.0),
    "version that crashes": Scenario(version("v2", crashes=True), version("v1"), 25.0),
}


def trouble_after(scenario: Scenario, fault: tuple[int, Fate], outcome: Any) -> str:
    """Return what a fault has led to; "": nothing."""
    try:
        cluster = scenario.play(fault)
        trouble, since = ["not begun"], cluster.now
        while trouble and cluster.now < since + PATIENCE:
            cluster.wait(5.0, tick=0.5)
            trouble = cluster.under_way()
            if cluster.outcome() != outcome:
                trouble.append(f"outcome: {cluster.outcome()}")
        return "; ".join(trouble)
    except AssertionError as violation:
        return str(violation)


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_ends_alike_whatever_befalls_a_message(name: str) -> None:
    scenario = SCENARIOS[name]
    undisturbed = scenario.play()
    assert not undisturbed.under_way()
    sent, outcome = undisturbed.sent_messages, undisturbed.outcome()
    faults = [(number, fate) for number in range(len(sent)) for fate in FATES]
    if os.environ.get("ROSRM_FATES") != "all":
        faults = Random(name).sample(faults, min(SAMPLE, len(faults)))
    found = {fault: trouble_after(scenario, fault, outcome) for fault in faults}
    troubles = [f"{sent[n]}: {fate}: {why}" for (n, fate), why in found.items() if why]
    assert not troubles, "\n".join(troubles)
