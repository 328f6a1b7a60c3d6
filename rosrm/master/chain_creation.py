"""Creation of scoring policies while the master runs: other options, or the weights of a mode."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Final

from rosrm import clocks
from rosrm.errors import PluginError
from rosrm.extensions.guard import LOADING_LIMIT
from rosrm.extensions.placement import PolicySettings, ScoringLink
from rosrm.extensions.registry import Registry

#: Seconds for all creations in one turn of the loop; a quarter of the lease, if that is less.
CREATION_LIMIT: Final = 2.0
#: Maximum number of chains that are kept.
_MOST_KEPT: Final = 64


class ChainCreation:
    """Creates scoring policies in the master's loop, with one budget for each turn of the loop.

    While a plugin creates a policy, the master answers no host, so a slow one could make it lose
    all of them. A chain that was created is kept: the decision after a check uses it, and after a
    refusal for want of time the next request has less to create.

    Args:
        seconds: for all creations of one turn. Those before the first turn may take
            `LOADING_LIMIT`, because the master serves no host yet.
    """

    def __init__(self, registry: Registry, seconds: float) -> None:
        self._registry, self._seconds = registry, seconds
        self._left = LOADING_LIMIT
        self._kept: dict[str, tuple[ScoringLink, ...]] = {}

    def begin_turn(self) -> None:
        """Begin a turn of the loop, between which the master serves its peers."""
        self._left = self._seconds

    def __call__(self, chain: Sequence[PolicySettings]) -> tuple[ScoringLink, ...]:
        """Return the scoring policies of a chain.

        Raises:
            ConfigError: a plugin is not installed, or refuses its options.
            PluginError: a plugin cannot be created, or not in time.
        """
        key = json.dumps([(one.name, one.weight, one.options) for one in chain], default=dict)
        if key not in self._kept:
            links = tuple(map(self._create, chain))
            while len(self._kept) >= _MOST_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = links
        return self._kept[key]

    def _create(self, one: PolicySettings) -> ScoringLink:
        if self._left <= 0.0:
            raise PluginError(
                f"scoring policy {one.name!r}: the creation of policies took {self._seconds:g} s, "
                "and the hosts wait meanwhile; try again"
            )
        began = clocks.awake_time()
        try:
            return self._registry.link(one.name, one.options, one.weight, seconds=self._left)
        finally:
            self._left -= clocks.awake_time() - began
