"""Demand of a process: needs, constraints and preferences for its placement."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Final, NamedTuple

from rosrm.core.master.state.links import Crossing
from rosrm.extensions.declared_fields import STANDARD_FIELDS
from rosrm.extensions.placement import NO_PLUGINS, PlacementPlugins
from rosrm.model.values import EMPTY, ProcessSpec, Relation

_MAPPINGS: Final = tuple(
    name for name in STANDARD_FIELDS if isinstance(getattr(ProcessSpec(""), name), Mapping)
)
_mappings_of: Final = attrgetter(*_MAPPINGS)
_plain_fields_of: Final = attrgetter(*(name for name in STANDARD_FIELDS if name not in _MAPPINGS))


class Neighbour(NamedTuple):
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


class RankingKey:
    """Values that are compared and hashed; the hash is computed once for several look-ups."""

    __slots__ = ("_hash", "_values")

    def __init__(self, *values: Hashable) -> None:
        self._values = values
        self._hash = hash(values)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RankingKey) and self._values == other._values


@dataclass(slots=True)  # not frozen, because each of thousands would take 1 µs more to create
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
        key: equal for demands with equal rankings.
        key_alone: equal for demands that differ by their neighbours and flows alone.
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
    key_alone: RankingKey = field(init=False, compare=False)

    def __post_init__(self) -> None:
        mappings = (*_mappings_of(self.spec), self.amounts, self.excluded)
        read = self.shared_plugins.reads
        self.key_alone = RankingKey(
            *_plain_fields_of(self.spec), self.estimated,
            *[tuple(sorted(one.items())) if one else () for one in mappings],
            self.headroom, self.near, *map(self._as_text, read),
        )  # fmt: skip
        around: tuple[Hashable, ...] = self.neighbours
        if self.traffic.flows:
            also_read = (name for name in self.plugins.reads if name not in read)
            around = (*around, self.traffic, *map(self._as_text, also_read))
        self.key = RankingKey(self.key_alone, *around) if around else self.key_alone

    def _as_text(self, field_name: str) -> str:
        """Return a field of the spec as text: 1, 1.0 and True are equal, a policy can tell them."""
        return repr(getattr(self.spec, field_name))

    @property
    def shared_plugins(self) -> PlacementPlugins:
        """Return the plugins that share their answers with all demands of the same `key_alone`."""
        return self.plugins.without_flows if self.traffic.flows else self.plugins

    @property
    def flows_are_read(self) -> bool:
        """Return True if a policy or filter may read the flows."""
        return self.shared_plugins is not self.plugins

    def alone(self) -> Demand:
        """Return the demand whose `key` is the `key_alone` of this one."""
        return replace(self, neighbours=(), traffic=NO_TRAFFIC, plugins=self.shared_plugins)

    @property
    def declared(self) -> frozenset[str]:
        """Return the resources that a host must have."""
        return frozenset(name for name, much in self.amounts.items() if much > 0) - self.estimated
