"""Starts the master's runtime from settings that were checked before: `rosrm master` executes this.

It imports neither pydantic nor typer nor rich: the memory of a master is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also while the rest is being imported
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import sys

from rosrm.config.settings import CheckpointChoice, ClusterConfig
from rosrm.extensions.registry import Registry
from rosrm.master.fallback_policy import fallback_of
from rosrm.master.runtime import MasterRuntime
from rosrm.runtime.bootstrap import Handover, run


def serve(handover: Handover) -> int:
    """Make what the configuration names, and be the master."""
    config = ClusterConfig.from_json(handover.settings)
    registry = Registry.load(handover.plugins)
    name = config.scoring.policy
    policy = registry.scoring(name, config.scoring.options)
    strategies = registry.migrations(config.migration.strategies)
    checkpoint = registry.checkpoint(_installed_policy(config, registry), config.checkpoint.options)
    rows = registry.rows("scoring", "migration", "checkpoint")
    fallback = fallback_of(registry, name)
    declared = registry.declared(name, config.migration.strategies)
    return MasterRuntime(
        config, policy, strategies, rows, fallback, checkpoint, declared=declared
    ).run()


def _installed_policy(config: ClusterConfig, registry: Registry) -> str | None:
    """What the file names was checked; settings without a file have a default, here or not."""
    policy = config.checkpoint.policy
    is_default = policy == CheckpointChoice().policy
    return None if is_default and policy not in registry.names("checkpoint") else policy


if __name__ == "__main__":
    sys.exit(run("master", serve))
