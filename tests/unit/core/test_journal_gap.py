"""Journal gap: the master detects lost newest records and starts no process twice."""

from __future__ import annotations

import copy

import pytest

from rosrm.core.master.recovery import journal_gap
from tests.unit.core.cluster import Cluster, process

LEASE = 10.0


class Loss:
    """Cluster whose journal loses all records from the construction of this object to `strike`.

    Attributes:
        seen: newest record number that the hosts know.
    """

    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster
        self.seen = 0
        self._kept = copy.deepcopy(cluster.intents)
        self._newest = len(cluster.records)

    def strike(self, *, fell: bool = False) -> None:
        """Kill the master and restore it from the remaining journal, before any registration."""
        cluster = self.cluster
        self.seen = len(cluster.records)
        cluster.intents.clear()
        cluster.intents.update(self._kept)
        cluster.kill_master()
        begin(cluster, self._newest, machine_rebooted=fell)

    def come_back(self, host: str, seen: int) -> None:
        """Register the host, which reports the newest record number it has seen."""
        self.cluster.register(self.cluster.machines[host], journal_seen=seen)


def begin(cluster: Cluster, newest: int, *, machine_rebooted: bool = False) -> None:
    """Start a master, which writes its restart records at once."""
    journal_gap.begin(cluster.state, newest, cluster.now, machine_rebooted=machine_rebooted)
    cluster.journal([journal_gap.intent(cluster.state)])


def kill_again(cluster: Cluster) -> None:
    """Kill the master of the gap, too; the next master has all records that it wrote."""
    cluster.kill_master()
    begin(cluster, len(cluster.records))


@pytest.fixture
def cluster() -> Cluster:
    return Cluster("a", "b", lease=LEASE)


def told(cluster: Cluster) -> list:
    return [record for record in cluster.records if record.kind == "journal_behind"]


def lost_with_p_on_b(cluster: Cluster) -> Loss:
    """Return a journal gap after which `p` is queued by the journal; both hosts are cordoned."""
    cluster.set_host("a", "cordon")
    cluster.set_host("b", "cordon")
    cluster.submit(process("p"))
    loss = Loss(cluster)
    cluster.set_host("b", "uncordon")
    assert cluster.where("p") == ["b"]
    return loss


def waits(cluster: Cluster) -> None:
    """Check that `p` is not assigned again and keeps running on b."""
    assert cluster.where("p") == ["b"]
    assert "the master waits for all hosts to report" in cluster["p"].reason


def test_a_gap_is_recorded_once_with_its_size(cluster) -> None:
    """The first host reveals the gap; later hosts cause a record only if they know more."""
    loss = Loss(cluster)
    cluster.submit(process("p"))
    loss.strike()
    seen = loss.seen
    loss.come_back("a", seen - 1)
    (record,) = told(cluster)
    assert record.facts["lost"] == seen - 1 - record.facts["newest"]
    assert record.host == "a"
    loss.come_back("b", seen - 1)
    assert len(told(cluster)) == 1


def test_a_complete_journal_shows_no_gap(cluster) -> None:
    """The journal has all records that hosts have seen, so work is assigned at once."""
    cluster.submit(process("p"))
    loss = Loss(cluster)
    loss.strike()
    loss.come_back("a", loss.seen)
    loss.come_back("b", loss.seen)
    cluster.submit(process("q"))
    assert told(cluster) == []
    assert cluster.phase("q") == "running"


def test_a_process_that_was_started_in_the_gap_never_runs_twice(cluster) -> None:
    """By the journal p is queued, while a host that registers later runs it.

    That instance ends first.
    """
    loss = lost_with_p_on_b(cluster)
    loss.strike()
    loss.come_back("a", loss.seen)
    cluster.set_host("a", "uncordon")
    for _ in range(20):
        cluster.wait(0.1)
        waits(cluster)
    loss.come_back("b", loss.seen)
    for _ in range(20):
        assert len(cluster.where("p")) <= 1
        cluster.wait(0.1)
    cluster.wait(LEASE)
    assert len(cluster.where("p")) == 1
    assert cluster.phase("p") == "running"


@pytest.mark.parametrize("there", [True, False])
def test_after_a_reboot_the_master_waits_for_all_known_hosts(cluster, there) -> None:
    """The master waits for every known host, though none can prove the gap.

    An absent host blocks placement for one lease.
    """
    loss = lost_with_p_on_b(cluster)
    loss.strike(fell=True)
    loss.come_back("a", 0)
    cluster.set_host("a", "uncordon")
    cluster.wait(2.0)
    waits(cluster)
    cluster.machines["b"].connected = there
    if there:
        loss.come_back("b", 0)
        cluster.wait(1.0)
        assert len(cluster.where("p")) == 1
    else:
        cluster.wait(LEASE)
        assert "a" in cluster.where("p")
    assert cluster.phase("p") == "running"


def test_a_master_that_is_killed_during_the_wait_keeps_waiting(cluster) -> None:
    """The next master waits for the same hosts, and then for no more."""
    loss = lost_with_p_on_b(cluster)
    loss.strike(fell=True)
    kill_again(cluster)
    loss.come_back("a", 0)
    cluster.set_host("a", "uncordon")
    cluster.wait(2.0)
    waits(cluster)
    loss.come_back("b", 0)
    cluster.wait(1.0)
    assert len(cluster.where("p")) == 1
    assert cluster.phase("p") == "running"
    assert "unheard" not in cluster.intents["cluster"]


def test_a_later_restart_does_not_wait_again(cluster) -> None:
    """Once all hosts have registered, a later restart of the master does not wait."""
    loss = Loss(cluster)
    loss.strike(fell=True)
    assert cluster.intents["cluster"]["unheard"]["fell"]
    loss.come_back("a", 0)
    loss.come_back("b", 0)
    cluster.wait(0.5)
    assert "unheard" not in cluster.intents["cluster"]
    kill_again(cluster)
    loss.come_back("a", 0)
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]


def test_a_gap_that_one_host_revealed_holds_for_the_next_master(cluster) -> None:
    """After both restarts the master still waits for the hosts that have not registered."""
    loss = lost_with_p_on_b(cluster)
    loss.strike()
    loss.come_back("a", loss.seen)
    kill_again(cluster)
    loss.come_back("a", 0)
    cluster.set_host("a", "uncordon")
    cluster.wait(2.0)
    waits(cluster)
    cluster.machines["b"].connected = False
    cluster.wait(LEASE)
    assert "a" in cluster.where("p")
    assert "unheard" not in cluster.intents["cluster"]


@pytest.mark.parametrize("killed", [False, True])
def test_instance_numbers_from_the_gap_are_not_used_again(cluster, killed) -> None:
    """This includes ended instances that no host remembers, and holds for the next master, too."""
    loss = Loss(cluster)
    cluster.submit(process("p"))
    given = cluster["p"].owner
    cluster.cancel("p")
    loss.strike()
    seen = loss.seen
    for machine in cluster.machines.values():
        machine.slave.held.clear()
    loss.come_back("a", seen)
    if killed:
        kill_again(cluster)
        loss.come_back("a", 0)
    loss.come_back("b", 0 if killed else seen)
    cluster.wait(LEASE)
    cluster.submit(process("q"))
    cluster.wait(0.2)
    assert cluster["q"].owner > given + 100


def test_an_invalid_record_number_costs_one_lease(cluster) -> None:
    """An invalid record number costs one lease and no instance numbers."""
    loss = Loss(cluster)
    loss.strike()
    loss.come_back("a", 2**63)
    cluster.wait(LEASE + 0.2)
    cluster.submit(process("p"))
    assert cluster.phase("p") == "running"
