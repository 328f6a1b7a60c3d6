"""Plugins and registries of offers made in a test."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Final

from rosrm.extensions.contracts import (
    CheckpointOffer,
    FilterOffer,
    LauncherOffer,
    MigrationOffer,
    ProbeOffer,
    ScoringOffer,
)
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.registry import Registry
from rosrm.extensions.sinks import SinkOffer

HOOKS: Final = {
    CheckpointOffer: "register_checkpoint_policies",
    FilterOffer: "register_filters",
    LauncherOffer: "register_launchers",
    MigrationOffer: "register_migration_strategies",
    ProbeOffer: "register_probes",
    ScoringOffer: "register_scoring_policies",
    SinkOffer: "register_event_sinks",
}


def plugin(*offers: Any, **answers: Any) -> SimpleNamespace:
    """Return a plugin of these offers; `answers` are what further hooks return or raise."""
    for offer in offers:
        answers.setdefault(HOOKS[type(offer)], []).append(offer)
    return SimpleNamespace(**{name: _hook(name, answer) for name, answer in answers.items()})


def registry_of(*offers: Any) -> Registry:
    """Return a registry with these offers, by one plugin of the name `ours`."""
    return Registry.of(ours=plugin(*offers))


def _hook(name: str, answer: Any) -> Any:
    def hook() -> Any:
        if isinstance(answer, BaseException):
            raise answer
        return answer

    hook.__name__ = name
    return hookimpl(hook)
