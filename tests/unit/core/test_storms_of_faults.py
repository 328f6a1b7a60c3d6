"""Many messages between master and slaves are lost, late or repeated, and programs and parts end.

After a storm all messages arrive again. Then each order ends: nothing is under way, each process
that should run runs exactly once, and its supervisor applies the restart policy of its spec.

By default each kind of move meets few storms. `ROSRM_STORMS=N` takes N of them.
"""

from __future__ import annotations

import os
from random import Random
from typing import Any, Literal

import pytest

from rosrm.model.values import LifecyclePolicy, MigrationPolicy, RestartPolicy, StandbyPolicy
from tests.unit.core.cluster import node
from tests.unit.core.three_cores import Fate, FateOf, ThreeCores

STORMS = int(os.environ.get("ROSRM_STORMS", "4"))
#: Seconds of a storm, and most seconds after it until each order has ended.
STORM = 15.0
PATIENCE = 150.0
#: A policy by which a program may crash as often as it does here.
RESTARTS = RestartPolicy("on-failure", delay=0.3, max_delay=1.0, attempts=1000)
#: Number of messages among a thousand that meet each fate.
FATES: dict[Fate, int] = {
    "lost": 120, "late": 40, "twice": 40, "slave killed": 4, "supervisor killed": 4,
    "master killed before": 4, "master killed after": 4, "host cut": 6,
}  # fmt: skip
MOVES: dict[str, dict[str, Any]] = {
    "relaunch": {},
    "handoff": {},
    "criu": {},
    "lifecycle_node": {"lifecycle": LifecyclePolicy("active", 5.0)},
    "standby": {"standby": StandbyPolicy(wanted=True)},
}


def fates(random: Random) -> FateOf:
    """Return random fates of messages.

    No copy of a setting arrives after a newer one, because the orders of a master arrive in order.
    """
    words: list[Fate | Literal[""]] = [*FATES, ""]
    weights = [*FATES.values(), 1000 - sum(FATES.values())]

    def fate_of(_number: int, message: str) -> Fate | Literal[""]:
        (fate,) = random.choices(words, weights)
        in_order = message.startswith(("AmendInstance", "SetLifecycleState"))
        return "" if in_order and fate in ("late", "twice") else fate

    return fate_of


def crash(cluster: ThreeCores, random: Random) -> None:
    """Let one of the programs fail."""
    running = [(host, one) for host in cluster.hosts for one in host.programs]
    if running:
        host, instance = random.choice(running)
        host.exit(instance, host.programs[instance].pid, code=3)


def troubles_after(move: str, number: int) -> list[str]:
    """Return the differences from the expected state after a storm; []: none."""
    random = Random(f"{move} {number}")
    cluster = ThreeCores("abc")
    moves = MigrationPolicy("handoff" if move == "standby" else move)
    cluster.submit(node("p", command=("v1",), migration=moves, restart=RESTARTS, **MOVES[move]))
    cluster.wait(6.0)
    cluster.disturb(fates(random))
    until = cluster.now + STORM
    acts = [
        lambda: cluster.migrate("p"), lambda: cluster.restart("p"), lambda: crash(cluster, random)
    ]  # fmt: skip
    while cluster.now < until:
        random.choices(acts, [3, 1, 4])[0]()
        cluster.wait(random.choice([0.2, 0.4, 1.0, 2.0]))
    cluster.disturb()
    troubles, since = ["not looked at"], cluster.now
    while troubles and cluster.now < since + PATIENCE:
        cluster.wait(5.0, tick=0.5)
        troubles = cluster.under_way()
        if cluster.outcome() != {"p": ("running", 1 + (move == "standby"))}:
            troubles.append(f"outcome: {cluster.outcome()}")
    return troubles


@pytest.mark.parametrize("number", range(STORMS))
@pytest.mark.parametrize("move", MOVES)
def test_after_a_storm_each_process_runs_once_by_its_policy(move: str, number: int) -> None:
    assert not troubles_after(move, number)
