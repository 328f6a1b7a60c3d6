"""Creation of the scoring policies and filters that a cluster's settings select."""

from __future__ import annotations

from rosrm.config.settings import ClusterConfig
from rosrm.extensions.placement import PlacementPlugins
from rosrm.extensions.registry import Registry


def placement_of(config: ClusterConfig, registry: Registry) -> PlacementPlugins:
    """Return the selected policies and filters, without a fallback.

    Raises:
        ConfigError: a plugin is not installed, or refuses its options.
        PluginError: a plugin cannot be created.
    """
    chain = [registry.link(one.policy, one.options, one.weight) for one in config.scoring]
    return PlacementPlugins(tuple(chain), filters=registry.filters(config.filters))
