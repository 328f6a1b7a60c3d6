"""Every shipped checkpoint policy holds the contract that a third party's holds."""

from dataclasses import replace
from typing import ClassVar

import pytest

from rosrm.extensions.contracts import CheckpointChoice, CheckpointOffer, CheckpointView, MemoryView
from rosrm.model.values import ProcessSpec
from rosrm.testing import CheckpointContract
from rosrm_checkpoint import plugin
from rosrm_checkpoint.other_host import OtherHost, OtherHostOptions

OFFERS = {offer.name: offer for offer in plugin.register_checkpoint_policies()}
HOSTS = {f"h{n}": {"rack": str(n % 2)} for n in range(6)}


class TestOtherHost(CheckpointContract):
    offer = OFFERS["other-host"]


class TestOtherHostWithCopiesApart(CheckpointContract):
    offer = OFFERS["other-host"]
    options: ClassVar = {"copies": 2, "apart_by": "rack", "every": 0.2}


def test_each_shipped_policy_is_here():
    """A policy that is added to the plugin must be added here."""
    assert set(OFFERS) <= {contract.offer.name for contract in CheckpointContract.__subclasses__()}


def view(name: str = "p", **fields) -> CheckpointView:
    spec = ProcessSpec(name, command=("true",))
    return replace(CheckpointView(spec, "h0", None, 10, (), HOSTS), **fields)


def choose(asked: CheckpointView, **options) -> CheckpointChoice:
    choice = OtherHost(OtherHostOptions(**options)).choose(asked)
    assert choice is not None
    return choice


def test_so_many_copies():
    """As many as there are hosts for."""
    assert len(choose(view(), copies=3).hosts) == 3
    assert len(choose(view(), copies=9).hosts) == 5
    assert choose(view(hosts={"h0": {}})).hosts == ()


def test_apart_comes_first():
    """Then those that are not: a copy nearby is better than none."""
    assert set(choose(view(), copies=3, apart_by="rack").hosts) == {"h1", "h3", "h5"}
    near = {name: labels for name, labels in HOSTS.items() if labels["rack"] == "0"}
    assert choose(view(hosts=near), apart_by="rack").hosts in {("h2",), ("h4",)}


def test_a_host_without_the_label_is_not_known_to_be_apart():
    """A host without the label does not count as one with another value."""
    bare = {f"x{n}": {} for n in range(9)}
    assert choose(view(hosts={**bare, **HOSTS}), apart_by="rack").hosts[0] in HOSTS


def test_a_replica_moves_to_a_host_that_is_apart():
    """A host with another label replaces the host with the same label, once it is up."""
    choice = choose(view(replica_hosts=("h2",)), apart_by="rack")
    assert HOSTS[choice.hosts[0]]["rack"] == "1"


def test_processes_are_spread_over_the_hosts():
    """Not all states lie on one host."""
    counts = dict.fromkeys(HOSTS, 0)
    for number in range(500):
        counts[choose(view(f"p{number}")).hosts[0]] += 1
    assert counts.pop("h0") == 0
    assert min(counts.values()) > 50


def test_a_process_that_stood_still_for_long_runs_for_longer():
    """So that it is away for 5 % of the time; a quick one is dumped as often as it asks."""
    policy = OtherHost(OtherHostOptions())
    spec = ProcessSpec("p", command=("true",))
    assert policy.pace(MemoryView(spec, "h0", 60.0, 0, 0.0)) == 60.0
    assert policy.pace(MemoryView(spec, "h0", 60.0, 1000, 0.5)) == 60.0
    assert policy.pace(MemoryView(spec, "h0", 60.0, 1000, 9.0)) == 180.0


def test_a_policy_that_follows_the_order_of_the_copies_is_caught():
    """`replica_hosts` changes its order by the second, so the copies would travel to and fro."""

    class Follows:
        def choose(self, process):
            others = [name for name in process.hosts if name != process.host]
            first = [name for name in process.replica_hosts if name in others][:1]
            rest = [name for name in others if name not in first]
            at = (others.index(first[0]) + 1) % len(rest) if first else 0
            return CheckpointChoice((*first, *rest[at : at + 2 - len(first)]))

    contract = CheckpointContract()
    contract.offer = CheckpointOffer("follows", lambda options: Follows())
    contract.test_chooses_hosts_that_are_there()
    with pytest.raises(AssertionError, match="it chooses"):
        contract.test_stays_with_its_choice()
