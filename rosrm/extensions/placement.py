"""The selected plugins that judge hosts: scoring policies and filters, with the guard of calls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from rosrm.extensions.contracts import PlacementFilter, ScoringPolicy
from rosrm.extensions.declared_fields import FLOWS_FIELD
from rosrm.extensions.plugin_calls import PluginCalls
from rosrm.wording import weighted


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """Settings of a scoring policy of a chain, with the factor of its scores in the sum."""

    name: str
    weight: float
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ScoringLink:
    """A scoring policy, as a link of a chain.

    Attributes:
        weight: factor of its scores in the sum of the chain.
        reads: fields of the spec that its offer declares.
    """

    name: str
    policy: ScoringPolicy
    weight: float = 1.0
    reads: tuple[str, ...] = ()

    def __str__(self) -> str:
        return weighted(self.name, self.weight)


@dataclass(frozen=True, slots=True)
class SelectedFilter:
    """A placement filter of a plugin; the other attributes are those of its offer."""

    name: str
    filter: PlacementFilter
    permanent: bool = False
    reads: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PlacementPlugins:
    """The plugins that a master asks about hosts.

    Attributes:
        chain: the scoring policies whose weighted scores are added.
        fallback: the scoring policy that is used if each one of the chain fails; None: none.
        filters: in the order in which they are asked.
        calls: guards every call of them.
        reads: all fields of the spec that one of them reads beyond the standard ones.
        without_flows: those that do not read the flows of a process, without a fallback.
    """

    chain: tuple[ScoringLink, ...] = ()
    fallback: ScoringLink | None = None
    filters: tuple[SelectedFilter, ...] = ()
    calls: PluginCalls = field(default_factory=PluginCalls, compare=False)
    reads: tuple[str, ...] = field(init=False, compare=False)
    without_flows: PlacementPlugins = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Set `reads` to the fields that the offers declare, each once, and `without_flows`."""
        fallback = () if self.fallback is None else (self.fallback,)
        readers: tuple[ScoringLink | SelectedFilter, ...] = (*self.chain, *fallback, *self.filters)
        read = (name for one in readers for name in one.reads)
        object.__setattr__(self, "reads", tuple(dict.fromkeys(read)))
        rest = self
        if FLOWS_FIELD in self.reads:
            chain = tuple(one for one in self.chain if FLOWS_FIELD not in one.reads)
            filters = tuple(one for one in self.filters if FLOWS_FIELD not in one.reads)
            rest = replace(self, chain=chain, filters=filters, fallback=None)
        object.__setattr__(self, "without_flows", rest)


#: Creates the policies of a chain.
ChainOf = Callable[[Sequence[PolicySettings]], tuple[ScoringLink, ...]]

#: No policy and no filter: each host that fits scores 0.
NO_PLUGINS = PlacementPlugins()
