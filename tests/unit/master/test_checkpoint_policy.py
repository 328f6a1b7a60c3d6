"""Checkpoint policy of a master, also where its plugin cannot be used."""

from __future__ import annotations

import pytest

from rosrm.config.cluster import default_cluster
from rosrm.config.settings import CheckpointPolicySettings
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.contracts import (
    CheckpointChoice,
    CheckpointOffer,
    CheckpointView,
    MemoryView,
    MigrationOffer,
    ScoringOffer,
)
from rosrm.extensions.registry import Registry
from rosrm.master.checkpoint_policy import checkpoint_policy
from rosrm.model.orders import DropReplica
from tests import plugin_kit
from tests.unit.core.test_replication import Asked, keep, others, running, use, where

#: Default settings, which another installation may have checked.
DEFAULT = CheckpointPolicySettings()
OFFER = CheckpointOffer("other-host", lambda _options: Asked())
NAMELESS = plugin_kit.plugin(register_checkpoint_policies=OSError("Too many open files"))


@pytest.mark.parametrize(
    ("registry", "said"),
    [
        (Registry.of(), "unknown checkpoint policy 'other-host'. None is installed"),
        (Registry.of(checkpoint=NAMELESS), "Too many open files"),
        (Registry.of(one=plugin_kit.plugin(OFFER), two=plugin_kit.plugin(OFFER)), "uninstall all"),
    ],
)
def test_a_master_without_the_plugin_of_the_default_policy_drops_no_replica(registry, said, caplog):
    """A master that restarts while the plugin cannot be loaded keeps what it would lose else."""
    policy = Asked()
    cluster = running(policy)
    host, other = where(cluster), others(cluster)[0]
    policy.answer = CheckpointChoice((other,), 1.0)
    cluster.wait(2.0)
    keep(cluster, other, ("p", cluster["p"].owner, 5))
    cluster.restart_master()
    use(cluster, checkpoint_policy(registry, DEFAULT))
    cluster.wait(1.0)
    keep(cluster, host, ("p", cluster["p"].owner, 9))
    keep(cluster, other, ("p", cluster["p"].owner, 5))
    cluster.wait(4.0)
    assert cluster.orders(DropReplica) == []
    assert said in caplog.text


def test_a_policy_that_is_not_available_makes_no_checkpoint_of_memory() -> None:
    """The refusal names the reason."""
    policy = checkpoint_policy(Registry.of(), DEFAULT)
    assert policy.choose(CheckpointView(None, "a", None, 0, (), {})) is None
    with pytest.raises(PluginError, match="None is installed"):
        policy.pace(MemoryView(None, "a", 1.0, 0, 0.0))


def test_only_the_file_selects_no_policy() -> None:
    """Another policy than the default one has to be there, as the file was checked before."""
    assert checkpoint_policy(Registry.of(), CheckpointPolicySettings(None)) is None
    with pytest.raises(ConfigError, match="unknown checkpoint policy 'racks'"):
        checkpoint_policy(Registry.of(), CheckpointPolicySettings("racks"))
    assert isinstance(checkpoint_policy(plugin_kit.registry_of(OFFER), DEFAULT), Asked)


@pytest.mark.parametrize("offers", [(), (OFFER,)])
def test_default_settings_name_the_default_policy_even_if_it_is_not_installed(offers) -> None:
    """Otherwise the master could not tell a plugin that does not load from `policy: null`."""
    scoring = ScoringOffer("weighted", lambda _options: None)
    relaunch = MigrationOffer("relaunch", lambda _options: None)
    config = default_cluster(plugin_kit.registry_of(scoring, relaunch, *offers))
    assert config.checkpoint == DEFAULT
