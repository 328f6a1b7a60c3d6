"""Assembly of the master from its settings and the configured plugins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rosrm.config.placement import placement_of
from rosrm.config.settings import ClusterConfig
from rosrm.extensions.guard import Crash
from rosrm.extensions.registry import MASTER_KINDS, Registry
from rosrm.master.chain_creation import CREATION_LIMIT, ChainCreation
from rosrm.master.checkpoint_policy import checkpoint_policy
from rosrm.master.fallback_policy import fallback_of
from rosrm.master.runtime import MasterRuntime
from rosrm.master.settings_reload import SettingsReload
from rosrm.ros.participant import Participant
from rosrm.runtime.bootstrap import Handover


def new_runtime(
    config: ClusterConfig, handover: Handover, participant: Participant,
    crashes: Sequence[Crash] = (),
) -> MasterRuntime:  # fmt: skip
    """Create the configured plugins, and return a master with them.

    Args:
        crashes: calls of plugins in which former masters have ended.
    """
    registry = Registry.load(handover.plugins, MASTER_KINDS)
    registry.note_crashes(crashes)
    placement = placement_of(config, registry)
    strategies = registry.migrations(config.migration.strategies)
    checkpoint = checkpoint_policy(registry, config.checkpoint)
    rows = registry.rows(*MASTER_KINDS)
    placement = replace(placement, fallback=fallback_of(registry, config))
    declared = registry.declared(config.migration.strategies)
    chains = ChainCreation(registry, min(CREATION_LIMIT, config.liveness.lease / 4.0))
    reload = SettingsReload(config, handover.source, chains)
    return MasterRuntime(
        config, participant, placement, strategies, rows, checkpoint,
        declared=declared, reload=reload,
    )  # fmt: skip
