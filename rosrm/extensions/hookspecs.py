"""Every hook that a plugin may implement.

A plugin is a module or object under the entry-point group `rosrm`. rosrm calls its hooks once, at
start. They return offers, from which rosrm creates objects. Later calls go directly to these
objects, not through pluggy. Example::

    from rosrm import ScoringOffer, hookimpl

    @hookimpl
    def register_scoring_policies():
        return [ScoringOffer(name="fewest", create=lambda options: FewestProcesses())]
"""

from __future__ import annotations

from collections.abc import Sequence

import pluggy

from rosrm.extensions.contracts import (
    CheckpointOffer,
    FilterOffer,
    LauncherOffer,
    MigrationOffer,
    ProbeOffer,
    ScoringOffer,
)
from rosrm.extensions.installed import GROUP
from rosrm.extensions.sinks import SinkOffer

# The group of the entry points is also the name of the pluggy project.
hookspec = pluggy.HookspecMarker(GROUP)
#: Decorator that marks the hooks of a plugin.
hookimpl = pluggy.HookimplMarker(GROUP)


@hookspec
def register_probes() -> Sequence[ProbeOffer]:  # type: ignore[empty-body]  # a specification
    """Offer probes, which read the utilisation of a host's resources (loaded by slaves)."""


@hookspec
def register_scoring_policies() -> Sequence[ScoringOffer]:  # type: ignore[empty-body]
    """Offer scoring policies, which order the hosts that fit a process (loaded by the master)."""


@hookspec
def register_filters() -> Sequence[FilterOffer]:  # type: ignore[empty-body]
    """Offer filters, the rules by which hosts may take a process (loaded by the master)."""


@hookspec
def register_migration_strategies() -> Sequence[MigrationOffer]:  # type: ignore[empty-body]
    """Offer migration strategies, which plan migrations (master), with their executors (slaves)."""


@hookspec
def register_checkpoint_policies() -> Sequence[CheckpointOffer]:  # type: ignore[empty-body]
    """Offer checkpoint policies, which place replicas and schedule checkpoints (master)."""


@hookspec
def register_launchers() -> Sequence[LauncherOffer]:  # type: ignore[empty-body]
    """Offer launchers, which replace the command line of an instance (slaves)."""


@hookspec
def register_event_sinks() -> Sequence[SinkOffer]:  # type: ignore[empty-body]
    """Offer event sinks, which pass events and alerts on (loaded by `rosrm alerts`)."""
