"""Fallback of the scoring policy."""

from __future__ import annotations

from types import SimpleNamespace

from rosrm.config.settings import ClusterConfig, ScoringChoice
from rosrm.extensions.contracts import ScoringOffer
from rosrm.extensions.placement import ScoringLink
from rosrm.master.fallback_policy import fallback_of
from tests import plugin_kit


def registry_of(**policies):
    """Return a registry of policies, each with its factory."""
    offers = (ScoringOffer(name, create) for name, create in policies.items())
    return plugin_kit.registry_of(*offers)


def broken(options):
    raise RuntimeError("out of order")


def settings(policy: str) -> ClusterConfig:
    return ClusterConfig(scoring=(ScoringChoice(policy),))


def test_the_default_policy_stands_in_for_another() -> None:
    """The fallback gets its own default options."""
    weighted = SimpleNamespace(score=None)
    registry = registry_of(weighted=lambda options: weighted, other=lambda options: object())
    assert fallback_of(registry, settings("other")) == ScoringLink("weighted", weighted)


def test_nothing_stands_in_for_the_default_policy_itself() -> None:
    """The default policy would fail in the same way."""
    registry = registry_of(weighted=lambda options: object())
    assert fallback_of(registry, settings("weighted")) is None


def test_a_default_policy_that_is_not_there_or_broken_is_not_missed() -> None:
    """The chosen policy has no fallback: on its failure, hosts that fit are taken in order."""
    other = settings("other")
    assert fallback_of(registry_of(other=lambda options: object()), other) is None
    assert fallback_of(registry_of(other=broken, weighted=broken), other) is None
