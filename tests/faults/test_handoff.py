"""Every participant of a handoff is killed at each of its steps: "moved" or "stayed", one active.

The words of the protocol are heard from outside, and the victim is killed with SIGKILL as soon as
one of them is. A killed master or slave is started again, as its service manager would.
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.core.model import MigrationPolicy, ProcessSpec, RestartPolicy
from tests.faults.watching import Watcher, blocks, instances, kill
from tests.ros.clusters import PATIENCE, QUICK, Cluster, host

pytestmark = pytest.mark.timeout(180)

ROOT = Path(__file__).resolve().parents[2]
NAME = "moving"
#: In their order. "says" is the master's word, the others are reported.
MOMENTS = [
    "says SHADOW", "SHADOWING", "ATTACHED", "READY", "says SWITCH", "SWITCHING", "SILENT",
    "RELEASED", "ACTIVE",
]  # fmt: skip
#: From here on the destination may have become active before the blow falls.
MAY_BE_ACTIVE = MOMENTS[MOMENTS.index("READY") :]


def counter() -> ProcessSpec:
    return ProcessSpec(
        NAME, module="benchmarks.handoff_nodes", arguments=("count", "--rate", "50"),
        environment={"PYTHONPATH": str(ROOT)}, ros=True, stop=QUICK,
        restart=RestartPolicy("on-failure", delay=0.2, attempts=100),
        migration=MigrationPolicy("handoff"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def cluster(make_shared) -> Cluster:
    one = make_shared(host("h0"), host("h1"), liveness=LivenessSettings())
    one.submit(counter())
    one.wait(NAME, "running")
    return one


@pytest.fixture(scope="module")
def watcher(cluster):
    one = Watcher(cluster.domain)
    yield one
    one.close()


def owner(cluster):
    return cluster.wait(NAME, "running")


def is_heard(watcher, number: int, outputs: int = 10) -> bool:
    """Whether an instance alone spoke last, and for a while."""
    last = watcher.outputs[-outputs:]
    return len(last) == outputs and {one.instance for one in last} == {number}


def settle(cluster, watcher):
    """Wait until one instance owns the name, alone is heard and alone is there; returns its row."""

    def settled(view) -> bool:
        row = next(row for row in view.processes if row.name == NAME)
        heard = row.state == "running" and is_heard(watcher, row.number)
        return heard and instances(cluster, NAME).keys() == {row.number}

    cluster.wait_until("one active instance", settled, PATIENCE)
    return owner(cluster)


def strike(cluster, watcher, moment: str, find) -> None:
    """Begin to move, and kill who `find` finds at a moment."""
    here = settle(cluster, watcher).host
    cluster.wait_for_hosts()
    watcher.outputs.clear()
    watcher.strike_at(moment, kill(find, signal.SIGKILL))
    cluster.client.migrate(NAME, "h1" if here == "h0" else "h0")
    assert watcher.struck.wait(PATIENCE), f"{moment} was not heard: {watcher.heard}"


def is_gapless(watcher) -> bool:
    sequence = [one.sequence for one in watcher.outputs]
    return sequence == list(range(sequence[0], sequence[0] + len(sequence)))


@pytest.mark.parametrize("moment", MOMENTS)
def test_the_master_is_killed(cluster, watcher, moment):
    """Nothing is lost or repeated: it goes on with the step in hand, or undoes it."""
    strike(cluster, watcher, moment, lambda: cluster.master.process.pid)
    cluster.master.process.wait(PATIENCE)
    cluster.reconnect()
    cluster.start_master()
    settle(cluster, watcher)
    assert is_gapless(watcher), watcher.outputs
    assert len(blocks(watcher.outputs)) <= 2, blocks(watcher.outputs)


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("whose", ["source", "destination"])
def test_a_slave_is_killed(cluster, watcher, moment, whose):
    """Its processes run on; nothing is lost or repeated."""
    here = settle(cluster, watcher).host
    there = "h1" if here == "h0" else "h0"
    victim = here if whose == "source" else there
    part = cluster.slaves[victim]
    strike(cluster, watcher, moment, lambda: part.process.pid)
    part.process.wait(PATIENCE)
    cluster.start_slave(next(one for one in cluster.hosts if one.host == victim))
    settle(cluster, watcher)
    assert is_gapless(watcher), watcher.outputs
    assert len(blocks(watcher.outputs)) <= 2, blocks(watcher.outputs)


@pytest.mark.parametrize("moment", MOMENTS)
def test_the_destination_is_killed(cluster, watcher, moment):
    """Before it is active the source goes on without a gap; after it, somebody does."""
    before = settle(cluster, watcher).number

    def shadow() -> int:
        return next(pid for n, pid in instances(cluster, NAME, shadows=True).items() if n > before)

    strike(cluster, watcher, moment, shadow)
    settle(cluster, watcher)
    if moment not in MAY_BE_ACTIVE:
        assert is_gapless(watcher), watcher.outputs
        assert len(blocks(watcher.outputs)) == 1


@pytest.mark.parametrize("moment", MOMENTS)
def test_the_source_is_killed(cluster, watcher, moment):
    """From SWITCH on its state is not lost; before, its policy starts it again."""
    source = settle(cluster, watcher).number
    strike(cluster, watcher, moment, lambda: instances(cluster, NAME)[source])
    settle(cluster, watcher)
    speakers = blocks(watcher.outputs)
    assert len(speakers) <= 2, speakers
    if moment in MAY_BE_ACTIVE:
        first, second = speakers
        # Killed in the middle of a cycle, its last output may be said again.
        assert second[0].sequence in (first[-1].sequence, first[-1].sequence + 1)


def test_a_source_that_will_not_die_is_killed(cluster, watcher):
    """It ignores SIGINT and SIGTERM (it is stopped): SIGKILL ends it after its grace."""
    row = settle(cluster, watcher)
    watcher.outputs.clear()
    watcher.strike_at(
        "RELEASED", kill(lambda: instances(cluster, NAME)[row.number], signal.SIGSTOP)
    )
    cluster.client.migrate(NAME, "h1" if row.host == "h0" else "h0")
    assert watcher.struck.wait(PATIENCE), watcher.heard
    after = settle(cluster, watcher)
    assert after.number != row.number
    assert is_gapless(watcher)
