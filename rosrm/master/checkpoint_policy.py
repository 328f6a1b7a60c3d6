"""Checkpoint policy of the master, also where the plugin of the default one is not available."""

from __future__ import annotations

import logging

from rosrm.config.settings import CheckpointPolicySettings
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.contracts import (
    CheckpointChoice,
    CheckpointPolicy,
    CheckpointView,
    MemoryView,
)
from rosrm.extensions.registry import Registry

_log = logging.getLogger("rosrm.master")


def checkpoint_policy(
    registry: Registry, settings: CheckpointPolicySettings
) -> CheckpointPolicy | None:
    """Create the checkpoint policy; None: the file selects none.

    Without the plugin of the default policy, replicas stay where they are: the plugin may be
    installed and not load at this start only, and the replicas may be the last copies.

    Raises:
        ConfigError: the policy is unknown, or its options are invalid.
        PluginError: the policy cannot be created.
    """
    name = settings.policy
    if name is not None and name == CheckpointPolicySettings().policy:
        try:
            registry.offer("checkpoint", name)
        except ConfigError as error:
            _log.warning("replicas of snapshots stay on the hosts that have them: %s", error)
            return _Unavailable(str(error))
    return registry.checkpoint(name, settings.options)


class _Unavailable:
    """Checkpoint policy that changes nothing, in place of one that is not available."""

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def choose(self, _process: CheckpointView) -> CheckpointChoice | None:
        return None

    def pace(self, _process: MemoryView) -> float | None:
        raise PluginError(self._reason)
