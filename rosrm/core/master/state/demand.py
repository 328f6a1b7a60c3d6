"""Demand of a process: needs, constraints and preferences for its placement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Final

from rosrm.extensions.declared_fields import STANDARD_FIELDS
from rosrm.extensions.placement import NO_PLUGINS, PlacementPlugins
from rosrm.model.values import EMPTY, ProcessSpec, Relation

_MAPPINGS: Final = tuple(
    name for name in STANDARD_FIELDS if isinstance(getattr(ProcessSpec(""), name), Mapping)
)
_mappings_of: Final = attrgetter(*_MAPPINGS)
_plain_fields_of: Final = attrgetter(*(name for name in STANDARD_FIELDS if name not in _MAPPINGS))


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A rule of or about a process, with the current hosts of the other processes.

    Attributes:
        relation, by, prefer: as in `NeighbourRule`.
        at: (host, process) of each instance of the others, in order.
        absent: why there is no host near which the process could run; "": there is one.
    """

    relation: Relation
    by: str
    prefer: bool
    at: tuple[tuple[str, str], ...] = ()
    absent: str = ""


#: Values that decide about a ranking: those of the process alone, and its neighbours.
RankingKey = tuple[tuple[Any, ...], tuple[Neighbour, ...]]


@dataclass(frozen=True, slots=True)
class Demand:
    """Inputs of the placement of one process; equal demands share a ranking.

    Attributes:
        amounts: needs in base units by resource.
        estimated: resources with an estimated amount, neither declared nor measured.
        excluded: host name to the reason why the process must not run there.
        headroom: fraction by which a host must stay under each limit.
        near: hosts with a replica of its snapshot; each counts as one more preferred label.
        neighbours: rules on its hosts, relative to other processes.
        plugins: the policies and filters that judge hosts.
        key: equal for demands with equal rankings; its first part, for demands that differ by
            their neighbours alone.
    """

    spec: ProcessSpec
    amounts: Mapping[str, float]
    estimated: frozenset[str] = frozenset()
    excluded: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    headroom: float = 0.0
    near: tuple[str, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()
    plugins: PlacementPlugins = field(default=NO_PLUGINS, compare=False)
    key: RankingKey = field(init=False, compare=False)

    def __post_init__(self) -> None:
        without_neighbours = (
            *_plain_fields_of(self.spec), *map(_key, _mappings_of(self.spec)),
            _key(self.amounts), self.estimated, _key(self.excluded), self.headroom, self.near,
            # As text, because 1, 1.0 and True are equal and a policy can tell them apart.
            *(repr(getattr(self.spec, name)) for name in self.plugins.reads),
        )  # fmt: skip
        object.__setattr__(self, "key", (without_neighbours, self.neighbours))

    @property
    def declared(self) -> frozenset[str]:
        """Return the resources that a host must have."""
        return frozenset(name for name, much in self.amounts.items() if much > 0) - self.estimated


def _key(mapping: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(mapping.items())) if mapping else ()
