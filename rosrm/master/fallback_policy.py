"""Fallback scoring policy, used if the configured one raises, hangs or returns invalid scores."""

from __future__ import annotations

import logging

from rosrm.config.settings import ScoringChoice
from rosrm.errors import ConfigError, PluginError, SkipPlugin
from rosrm.extensions.contracts import ScoringPolicy
from rosrm.extensions.registry import Registry

_log = logging.getLogger("rosrm.master")


def fallback_of(registry: Registry, chosen: str) -> tuple[str, ScoringPolicy] | None:
    """Return the default policy with its name; None if it is the chosen one, missing or broken."""
    name = ScoringChoice().policy
    if name == chosen or name not in registry.names("scoring"):
        return None
    try:
        return name, registry.scoring(name, {})
    except (ConfigError, PluginError, SkipPlugin) as fault:
        _log.warning("scoring %r cannot replace %r: %s", name, chosen, fault)
        return None
