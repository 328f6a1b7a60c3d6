"""A master whose journal has lost what was newest in it: it says so, and starts nothing twice."""

from __future__ import annotations

import copy

import pytest

from rosrm.core.master.recovery import journal_gap
from tests.unit.core.cluster import Cluster, process

LEASE = 10.0


class Loss:
    """A cluster whose journal loses all that is written from here until it strikes.

    Attributes:
        seen: newest record that hosts have been told of.
    """

    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster
        self.seen = 0
        self._kept = copy.deepcopy(cluster.intents)
        self._newest = len(cluster.records)

    def strike(self, *, fell: bool = False) -> None:
        """The master comes up from what is left; nobody is heard yet."""
        cluster = self.cluster
        self.seen = len(cluster.records)
        cluster.intents.clear()
        cluster.intents.update(self._kept)
        cluster.kill_master()
        begin(cluster, self._newest, fell=fell)

    def come_back(self, host: str, seen: int) -> None:
        """The host registers and says how much of the journal it has seen."""
        self.cluster.register(self.cluster.machines[host], journal_seen=seen)


def begin(cluster: Cluster, newest: int, *, fell: bool = False) -> None:
    """As a master does with its start: what it must remember becomes durable at once."""
    journal_gap.begin(cluster.state, newest, cluster.now, fell=fell)
    cluster.journal([journal_gap.intent(cluster.state)])


def kill_again(cluster: Cluster) -> None:
    """The master that came up from what is left is killed too; the next has all that it wrote."""
    cluster.kill_master()
    begin(cluster, len(cluster.records))


@pytest.fixture
def cluster() -> Cluster:
    return Cluster("a", "b", lease=LEASE)


def told(cluster: Cluster) -> list:
    return [record for record in cluster.records if record.kind == "journal_behind"]


def lost_with_p_on_b(cluster: Cluster) -> Loss:
    """By what will be left of the journal `p` is queued, and both hosts take no work."""
    cluster.set_host("a", "cordon")
    cluster.set_host("b", "cordon")
    cluster.submit(process("p"))
    loss = Loss(cluster)
    cluster.set_host("b", "uncordon")
    assert cluster.where("p") == ["b"]
    return loss


def waits(cluster: Cluster) -> None:
    """`p` is given to nobody, and runs where it was started in what is lost."""
    assert cluster.where("p") == ["b"]
    assert "the master waits for all hosts to report" in cluster["p"].reason


def test_it_is_said_once_with_how_much(cluster) -> None:
    """The first host tells; a second one that knows no more is no news, one that knows more is."""
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


def test_a_whole_journal_is_not_suspected(cluster) -> None:
    """What hosts have seen is there, and work is given at once."""
    cluster.submit(process("p"))
    loss = Loss(cluster)
    loss.strike()
    loss.come_back("a", loss.seen)
    loss.come_back("b", loss.seen)
    cluster.submit(process("q"))
    assert told(cluster) == []
    assert cluster.phase("q") == "running"


def test_what_was_started_in_what_is_lost_is_never_there_twice(cluster) -> None:
    """It is queued by what is left, and runs on a host that is heard later: that one ends first."""
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
def test_after_a_fall_of_the_machine_all_known_hosts_are_heard_first(cluster, there) -> None:
    """Though nobody has seen more than there is; a host that stays away holds it for a lease."""
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


def test_a_master_that_is_killed_while_it_waits_forgets_nothing_of_it(cluster) -> None:
    """After a fall of the machine: the next one waits for the same hosts, and then no more."""
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


def test_nothing_is_waited_for_twice(cluster) -> None:
    """All have come back, with nothing to do: a later restart of the master is as any other."""
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


def test_what_one_host_knew_to_be_lost_counts_for_the_next_master_too(cluster) -> None:
    """That host has seen no more than there is now; the others are still to be heard."""
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
def test_numbers_of_what_is_lost_are_not_given_again(cluster, killed) -> None:
    """Also of instances that have ended and that no host remembers, and by the next master."""
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


def test_an_absurd_number_harms_nobody(cluster) -> None:
    """A host that says nonsense costs a lease, not the numbers of instances."""
    loss = Loss(cluster)
    loss.strike()
    loss.come_back("a", 2**63)
    cluster.wait(LEASE + 0.2)
    cluster.submit(process("p"))
    assert cluster.phase("p") == "running"
