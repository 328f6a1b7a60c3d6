"""The contract of filters finds each violation, and passes a correct filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from rosrm.extensions.contracts import FilterOffer
from rosrm.testing import FilterContract
from rosrm.testing.calls import ContractBroken


@dataclass(frozen=True)
class RackOptions:
    rack: str = "1"


class Rack:
    def __init__(self, options):
        self._rack = options.rack

    def mask(self, hosts, process):
        return hosts.labelled("rack", self._rack)

    def reason(self, hosts, process, row):
        return f"it is not in rack {self._rack}"


class _Relative(Rack):
    """Passes the emptiest host only."""

    def mask(self, hosts, process):
        return hosts.processes <= hosts.processes.min(initial=9)


class _Standing(Rack):
    """Passes every second call."""

    calls = 0

    def mask(self, hosts, process):
        self.calls += 1
        return np.full(len(hosts.names), self.calls % 2 == 0)


class _Numbers(Rack):
    def mask(self, hosts, process):
        return np.ones(len(hosts.names))


class _Silent(Rack):
    def reason(self, hosts, process, row):
        return ""


class _Curious(Rack):
    def mask(self, hosts, process):
        return np.full(len(hosts.names), process.spec.environment == {})


class _Narrow(Rack):
    """Fails without hosts."""

    def mask(self, hosts, process):
        return np.full(len(hosts.names), hosts.usage[0, 0] < 2.0)


class TestRack(FilterContract):
    offer = FilterOffer("rack", Rack, RackOptions, "hosts of one rack", permanent=True)
    options: ClassVar = {"rack": "2"}


@pytest.mark.parametrize(
    ("broken", "test"),
    [
        (_Relative, "test_rows_are_independent"),
        (_Standing, "test_is_pure"),
        (_Numbers, "test_judges_every_host"),
        (_Silent, "test_gives_reasons"),
        (_Curious, "test_judges_every_host"),
        (_Narrow, "test_no_hosts"),
    ],
)
def test_a_broken_filter_fails(broken, test):
    contract = FilterContract()
    contract.offer = FilterOffer("broken", broken, RackOptions, "is broken")
    with pytest.raises((AssertionError, LookupError)):
        getattr(contract, test)()


def test_an_option_that_is_unknown_is_named():
    contract = FilterContract()
    contract.offer, contract.options = TestRack.offer, {"racks": "2"}
    with pytest.raises(ContractBroken, match="unknown key 'racks'; did you mean 'rack'"):
        contract.make()
