"""Demand of a process: needs, constraints and preferences for its placement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, Final, NamedTuple

from rosrm.core.master.state.links import Crossing
from rosrm.extensions.declared_fields import FLOWS_FIELD, STANDARD_FIELDS
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


class Flow(NamedTuple):
    """A flow between the process and another one, which has a host.

    Attributes:
        process: name of the other process.
        host, column: of the other process.
        rate: bytes a second.
        incoming: the process receives it from the other one, or declares it.
        learned: it was measured, not declared.
    """

    process: str
    host: str
    column: int
    rate: float
    incoming: bool
    learned: bool = False


class Traffic(NamedTuple):
    """The flows of a process, and their part in the load of the links.

    Attributes:
        flows: to all processes with a host.
        counted: flows of the process between hosts that the load of the links includes now.
        version: of the links.
    """

    flows: tuple[Flow, ...] = ()
    counted: tuple[Crossing, ...] = ()
    version: int = 0


NO_TRAFFIC: Final = Traffic()

#: Values that decide about a ranking: those of the process alone, and its neighbours and flows.
RankingKey = tuple[tuple[Any, ...], tuple[Neighbour | Traffic, ...]]


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
        traffic: flows between it and other processes.
        plugins: the policies and filters that judge hosts.
        key: equal for demands with equal rankings; its first part, for demands that differ by
            their neighbours alone, or by their flows, unless the policies read them.
    """

    spec: ProcessSpec
    amounts: Mapping[str, float]
    estimated: frozenset[str] = frozenset()
    excluded: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    headroom: float = 0.0
    near: tuple[str, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()
    traffic: Traffic = NO_TRAFFIC
    plugins: PlacementPlugins = field(default=NO_PLUGINS, compare=False)
    key: RankingKey = field(init=False, compare=False)

    def __post_init__(self) -> None:
        scored, added = self._traffic_keys()
        alone = (
            *_plain_fields_of(self.spec), *map(_key, _mappings_of(self.spec)),
            _key(self.amounts), self.estimated, _key(self.excluded), self.headroom, self.near,
            # As text, because 1, 1.0 and True are equal and a policy can tell them apart.
            *(repr(getattr(self.spec, name)) for name in self.plugins.reads), *scored,
        )  # fmt: skip
        object.__setattr__(self, "key", (alone, (*self.neighbours, *added)))

    def _traffic_keys(self) -> tuple[tuple[Traffic, ...], tuple[Traffic, ...]]:
        """Return the flows as a part of the first and of the second part of the key."""
        if not self.traffic.flows:
            return (), ()
        return ((self.traffic,), ()) if self.scores_flows else ((), (self.traffic,))

    @property
    def scores_flows(self) -> bool:
        """Return True if the scores of the policies may depend on the flows."""
        return FLOWS_FIELD in self.plugins.reads

    def alone(self) -> Demand:
        """Return the demand without what the second part of its key contains."""
        traffic = self.traffic if self.scores_flows else NO_TRAFFIC
        return replace(self, neighbours=(), traffic=traffic)

    @property
    def declared(self) -> frozenset[str]:
        """Return the resources that a host must have."""
        return frozenset(name for name, much in self.amounts.items() if much > 0) - self.estimated


def _key(mapping: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(mapping.items())) if mapping else ()
