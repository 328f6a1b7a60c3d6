"""Entry point of the master's runtime, executed by `rosrm master` with checked settings.

This module imports neither pydantic nor typer nor rich, because the master's memory is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also during the imports
from __future__ import annotations

import gc
import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)
gc.disable()  # a fifth of the start's CPU time; see `bootstrap.end_start`

import sys
from dataclasses import replace
from functools import partial

from rosrm.config.placement import chain_of, placement_of
from rosrm.config.settings import CheckpointPolicySettings, ClusterConfig
from rosrm.extensions.registry import Registry
from rosrm.master.fallback_policy import fallback_of
from rosrm.master.runtime import MasterRuntime
from rosrm.master.settings_reload import SettingsReload
from rosrm.runtime.bootstrap import Handover, run


def serve(handover: Handover) -> int:
    """Create the configured plugins and run the master; return the exit code."""
    config = ClusterConfig.from_json(handover.settings)
    registry = Registry.load(handover.plugins)
    placement = placement_of(config, registry)
    strategies = registry.migrations(config.migration.strategies)
    checkpoint = registry.checkpoint(_installed_policy(config, registry), config.checkpoint.options)
    rows = registry.rows("scoring", "filter", "migration", "checkpoint")
    placement = replace(placement, fallback=fallback_of(registry, config))
    declared = registry.declared(config.migration.strategies)
    reload = SettingsReload(config, handover.source, partial(chain_of, registry))
    return MasterRuntime(
        config, placement, strategies, rows, checkpoint, declared=declared, reload=reload
    ).run()


def _installed_policy(config: ClusterConfig, registry: Registry) -> str | None:
    """Return the checkpoint policy, or None if it is the default one and not installed.

    A policy that a file names was checked before, but the default may be missing.
    """
    policy = config.checkpoint.policy
    is_default = policy == CheckpointPolicySettings().policy
    return None if is_default and policy not in registry.names("checkpoint") else policy


if __name__ == "__main__":
    sys.exit(run("master", serve))
