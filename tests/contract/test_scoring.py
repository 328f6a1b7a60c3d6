"""The scoring contract, for every shipped policy, as for a third party's."""

from typing import ClassVar

import numpy as np
import pytest

from rosrm.extensions.contracts import Scores, ScoringOffer
from rosrm.testing import ScoringContract
from rosrm_scoring.plugin import register_scoring_policies

OFFERS = {offer.name: offer for offer in register_scoring_policies()}


class TestWeighted(ScoringContract):
    offer = OFFERS["weighted"]


class TestWeightedByGpu(TestWeighted):
    options: ClassVar = {"weights": {"gpu": 1.0, "gpu_memory": 0.3, "cpu": 0.1}}


class TestThreshold(ScoringContract):
    offer = OFFERS["threshold"]


class TestNarrowThreshold(TestThreshold):
    options: ClassVar = {"enter": 0.5, "leave": 0.4, "watch": ("gpu",), "weights": {}}


class TestNetwork(ScoringContract):
    offer = OFFERS["network"]


class TestNetworkByLocality(TestNetwork):
    options: ClassVar = {"load": 0.0, "latency": 0.0, "missing": "ignore"}


def test_each_shipped_policy_is_here():
    """Each policy in the plugin must have a contract class in this file."""
    held = {contract.offer.name for contract in ScoringContract.__subclasses__()}
    assert set(OFFERS) <= held


class _Relative:
    def score(self, hosts, process):
        memory = hosts.column("memory")
        return Scores(memory - (memory.mean() if len(memory) else 0.0))


class _Standing:
    buffer = np.zeros(0)

    def score(self, hosts, process):
        if len(self.buffer) < len(hosts.names):
            _Standing.buffer = np.zeros(len(hosts.names))
        value = self.buffer[: len(hosts.names)]
        value[:] = hosts.column("memory")
        return Scores(value)


class _Mutating:
    def score(self, hosts, process):
        hosts.usage[:] = 0.0
        return Scores(np.zeros(len(hosts.names)))


class _ByName:
    def score(self, hosts, process):
        return Scores(np.full(len(hosts.names), float(len(process.spec.name))))


class _Words:
    def score(self, hosts, process):
        return Scores(np.zeros(len(hosts.names)), ["no"] * len(hosts.names))


def test_a_declared_field_can_be_read():
    """The contract provides the fields that the offer declares, as the master does."""
    contract = ScoringContract()
    contract.offer = ScoringOffer("named", lambda options: _ByName(), reads=("name",))
    contract.test_scores_every_host()


def test_an_undeclared_field_fails_the_contract_with_its_name():
    """The error shows the declaration that is missing from the offer."""
    contract = ScoringContract()
    contract.offer = ScoringOffer("named", lambda options: _ByName())
    with pytest.raises(LookupError, match=r"'name'.*add reads=\('name',\) to the offer"):
        contract.test_scores_every_host()


@pytest.mark.parametrize(
    ("policy", "test"),
    [
        (_Relative, "test_rows_are_independent"),
        (_Words, "test_scores_every_host"),
        (_Standing, "test_is_pure"),
        (_Mutating, "test_is_pure"),
    ],
)
def test_contract_catches(policy, test):
    """A policy that breaks the contract fails the test of that clause."""
    contract = ScoringContract()
    contract.offer = ScoringOffer("bad", lambda options: policy())
    with pytest.raises(AssertionError):
        getattr(contract, test)()


class _Unending:
    def score(self, hosts, process):
        while True:
            try:  # noqa: SIM105 - as a careless plugin does
                sum(range(1000))
            except BaseException:  # noqa: BLE001
                pass


@pytest.mark.timeout(60)
def test_a_policy_that_catches_its_interrupt_fails_the_contract_with_its_place():
    """A loop that catches every exception ends, and the failure has the plugin's file and line."""
    contract = ScoringContract()
    contract.offer = ScoringOffer("bad", lambda options: _Unending())
    with pytest.raises(AssertionError, match=r"score took longer than 1 s.*test_scoring\.py:\d+"):
        contract.test_scores_every_host()
