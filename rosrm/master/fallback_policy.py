"""Fallback scoring policy, used if each configured one raises, hangs or returns invalid scores."""

from __future__ import annotations

import logging

from rosrm.config.settings import ClusterConfig, ScoringChoice
from rosrm.errors import ConfigError, PluginError, SkipPlugin
from rosrm.extensions.placement import ScoringLink
from rosrm.extensions.registry import Registry

_log = logging.getLogger("rosrm.master")


def fallback_of(registry: Registry, config: ClusterConfig) -> ScoringLink | None:
    """Return the default policy; None if it is configured, missing or broken."""
    name = ScoringChoice().policy
    configured = [one.policy for one in config.scoring]
    if name in configured or name not in registry.names("scoring"):
        return None
    try:
        return registry.link(name, {})
    except (ConfigError, PluginError, SkipPlugin) as fault:
        _log.warning("scoring %r cannot replace %s: %s", name, " and ".join(configured), fault)
        return None
