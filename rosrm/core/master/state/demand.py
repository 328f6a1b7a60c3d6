"""Demand of a process: all that placement depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Final

from rosrm.extensions.declared_fields import STANDARD_FIELDS
from rosrm.model.values import EMPTY, ProcessSpec

_MAPPINGS: Final = tuple(
    name for name in STANDARD_FIELDS if isinstance(getattr(ProcessSpec(""), name), Mapping)
)
_mappings_of: Final = attrgetter(*_MAPPINGS)
_plain_fields_of: Final = attrgetter(*(name for name in STANDARD_FIELDS if name not in _MAPPINGS))


@dataclass(frozen=True, slots=True)
class Demand:
    """All that the placement of a process depends on; equal demands share a ranking.

    Attributes:
        amounts: needs in base units by resource.
        estimated: resources whose amount is a guess, not declared and not measured.
        excluded: host name to the reason why it must not go there.
        headroom: fraction by which a host must stay under each limit.
        near: hosts with a replica of its snapshot; preferred as by one more preferred label.
        reads: fields of the spec that scoring policies read beyond the standard ones.
        key: equal for processes that every host judges alike.
    """

    spec: ProcessSpec
    amounts: Mapping[str, float]
    estimated: frozenset[str] = frozenset()
    excluded: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    headroom: float = 0.0
    near: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    key: tuple[Any, ...] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        key = (
            *_plain_fields_of(self.spec), *map(_key, _mappings_of(self.spec)),
            _key(self.amounts), self.estimated, _key(self.excluded), self.headroom, self.near,
            # As text, because 1, 1.0 and True are equal and a policy can tell them apart.
            *(repr(getattr(self.spec, name)) for name in self.reads),
        )  # fmt: skip
        object.__setattr__(self, "key", key)

    @property
    def declared(self) -> frozenset[str]:
        """Return the resources that a host must have."""
        return frozenset(name for name, much in self.amounts.items() if much > 0) - self.estimated


def _key(mapping: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(mapping.items())) if mapping else ()
