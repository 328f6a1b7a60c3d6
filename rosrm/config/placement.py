"""Creation of the scoring policies and filters that a cluster's settings select."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm.config.settings import ClusterConfig
from rosrm.extensions.placement import PlacementPlugins, PolicySettings, ScoringLink
from rosrm.extensions.registry import Registry


def placement_of(config: ClusterConfig, registry: Registry) -> PlacementPlugins:
    """Return the selected policies and filters, without a fallback; raises as `chain_of` does."""
    chain = chain_of(registry, settings_of_chain(config))
    return PlacementPlugins(chain, filters=registry.filters(config.filters), calls=registry.calls)


def settings_of_chain(config: ClusterConfig) -> tuple[PolicySettings, ...]:
    """Return the settings of the selected scoring policies."""
    return tuple(PolicySettings(one.policy, one.weight, one.options) for one in config.scoring)


def chain_of(registry: Registry, chain: Sequence[PolicySettings]) -> tuple[ScoringLink, ...]:
    """Create the scoring policies of a chain.

    Raises:
        ConfigError: a plugin is not installed, or refuses its options.
        PluginError: a plugin cannot be created.
    """
    return tuple(registry.link(one.name, one.options, one.weight) for one in chain)
