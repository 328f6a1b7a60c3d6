"""Creation of scoring policies while the master runs: no plugin holds its loop for long."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.core.master import events as happened
from rosrm.core.master.modes.settings import apply_settings
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.contracts import ScoringOffer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.placement import PolicySettings
from rosrm.extensions.registry import Registry
from rosrm.master.chain_creation import ChainCreation
from rosrm.model.modes import Mode
from rosrm.model.requester import OPERATOR
from tests.unit.core.cluster import Cluster

BUDGET = 0.3


@dataclass(frozen=True)
class Options:
    """Seconds that the creation takes, given as a weight so that a mode can set them."""

    weights: dict[str, float] = field(default_factory=dict)


class Plugin:
    """A scoring policy whose creation takes a while."""

    created = 0

    @hookimpl
    def register_scoring_policies(self) -> list[ScoringOffer]:
        return [ScoringOffer("slow", self.create, options=Options)]

    def create(self, options: Options) -> object:
        time.sleep(options.weights["seconds"])
        self.created += 1
        return SimpleNamespace(score=lambda *_: None)


@pytest.fixture
def plugin() -> Plugin:
    return Plugin()


@pytest.fixture
def chains(plugin: Plugin) -> ChainCreation:
    made = ChainCreation(Registry.of(ours=plugin), BUDGET)
    made.begin_turn()
    return made


def slow(seconds: float, name: str = "slow") -> tuple[PolicySettings, ...]:
    return (PolicySettings(name, 1.0, {"weights": {"seconds": seconds}}),)


def test_a_creation_that_hangs_ends_at_the_budget_of_its_turn(chains, plugin) -> None:
    """Then no further one begins in this turn; each turn has a budget of its own."""
    began = clocks.awake_time()
    with pytest.raises(PluginError, match=r"did not return within 0\.3 s"):
        chains(slow(1000.0))
    for _ in range(10):
        with pytest.raises(PluginError, match=r"creation of policies took 0\.3 s, .*; try again"):
            chains(slow(1000.0))
    assert clocks.awake_time() - began < 10 * BUDGET
    chains.begin_turn()
    (link,) = chains(slow(0.0))
    assert (link.name, plugin.created) == ("slow", 1)


def test_a_chain_is_created_once(chains, plugin) -> None:
    """The decision uses what its check has created."""
    assert chains(slow(0.0)) is chains(slow(0.0))
    assert plugin.created == 1


def test_many_chains_are_created_in_some_turns(chains, plugin) -> None:
    """What was created stays, so that a request which is repeated gets further."""
    wanted = [slow(0.1 + 0.001 * number) for number in range(5)]
    turns = 0
    while plugin.created < len(wanted):
        turns += 1
        assert turns < 10
        chains.begin_turn()
        try:
            for one in wanted:
                chains(one)
        except PluginError:
            continue
    assert turns > 1


def test_a_policy_that_is_not_installed_is_named(chains) -> None:
    """As at the start of the master."""
    with pytest.raises(ConfigError, match="unknown scoring policy 'gone'"):
        chains(slow(0.0, "gone"))


def test_modes_with_a_plugin_that_hangs_are_refused_in_time(chains) -> None:
    """Loading them, and the begin of a mode, held the master until its hosts were lost."""
    cluster = Cluster("a")
    cluster.state.chain_of = chains
    cluster.state.scoring = cluster.state.scoring_in_force = slow(0.0)
    modes = tuple(Mode(f"m{number}", (), weights={"seconds": 1000.0}) for number in range(5))
    began = clocks.awake_time()
    request = cluster.request(happened.ModesLoaded(0, modes, by=OPERATOR))
    reply = cluster.replies[request]
    assert not reply.accepted
    assert "mode m0: weights: scoring policy 'slow'" in reply.message
    assert clocks.awake_time() - began < 10 * BUDGET

    cluster.state.modes.known = {modes[0].name: modes[0]}
    cluster.state.modes.wanted = modes[0].name
    apply_settings(cluster.state)
    assert "its weights do not apply" in cluster.state.modes.fault["m0"]
    assert cluster.state.scoring_in_force == slow(0.0)
