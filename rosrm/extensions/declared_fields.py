"""Declarations of the selected plugins' offers, and the view of a spec that follows from them.

Processes that no policy can tell apart share one ranking. A scoring policy therefore reads only the
fields by which demands are compared: the standard ones, and those that its offer declares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, cast

from rosrm.extensions.contracts import Capabilities
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import listed

#: Fields of a spec that a policy may always read: `Demand.key` holds them.
STANDARD_FIELDS: Final = (
    "package", "executable", "module", "command", "namespace", "kind", "priority", "needs",
    "required_labels", "preferred_labels", "avoided_labels",
)  # fmt: skip
#: All fields of a spec: each of them may be declared.
SPEC_FIELDS: Final = tuple(f.name for f in fields(ProcessSpec))


class UndeclaredField(LookupError):
    """A policy reads a field of a spec that its offer does not declare.

    Not an AttributeError, because `getattr` with a default would silently return a wrong value.
    """


class DeclaredSpec:
    """A spec that gives a policy the standard fields and the declared ones, and no others."""

    __slots__ = ("_reads", "_spec")

    def __init__(self, spec: ProcessSpec, reads: tuple[str, ...]) -> None:
        self._spec = spec
        self._reads = reads

    def __getattr__(self, name: str) -> Any:
        if name in STANDARD_FIELDS or name in self._reads:
            return getattr(self._spec, name)
        if name in SPEC_FIELDS:
            raise UndeclaredField(
                f"the policy reads {name!r} of the spec, which its offer does not declare: "
                f"say ScoringOffer(..., reads={(*self._reads, name)!r})"
            )
        derived = getattr(ProcessSpec, name, None)
        if isinstance(derived, property) and derived.fget is not None:
            return derived.fget(self)
        raise AttributeError(f"a spec has no field {name!r}; it has {', '.join(SPEC_FIELDS)}")

    def __repr__(self) -> str:
        shown = (f for f in SPEC_FIELDS if f in STANDARD_FIELDS or f in self._reads)
        return f"DeclaredSpec({', '.join(f'{f}={getattr(self._spec, f)!r}' for f in shown)})"


def declared_spec(spec: ProcessSpec, reads: tuple[str, ...]) -> ProcessSpec:
    """Return the view of a spec for a policy that declares these fields."""
    return cast(ProcessSpec, DeclaredSpec(spec, reads))


def no_options(_strategy: str, _spec: ProcessSpec) -> Any:
    """Return None: no offer declares the options of a strategy."""
    return None


def no_capabilities(_spec: ProcessSpec) -> Capabilities:
    """Return the defaults: no offer says what the strategy of a process can do."""
    return Capabilities()


def no_standby(strategy: str | None, known: Mapping[str, Capabilities]) -> str:
    """Return why a process has no standby, and which strategies of the known ones give it one."""
    able = [f"`migration: {name}`" for name, it in known.items() if it.shadow]
    why = f"{strategy} cannot do that" if strategy else "without a migration strategy none can"
    remedy = f"say {listed(able, 'or')}" if able else "install a strategy that can"
    return f"a standby follows the state of its process, and {why}: {remedy}"


@dataclass(frozen=True)
class Declared:
    """Declarations of the selected plugins' offers.

    Attributes:
        reads: fields of a spec that scoring policies read beyond the standard ones.
        options_of: returns the options of a strategy for a spec, merged and parsed; raises
            `ValueError` for an option that the strategy does not accept.
        executors: names by strategy, of the offers that are known.
        brought_by: the distribution by strategy, where it is known.
        capabilities_of: returns what the strategy of a process can do for it; never raises.
        capabilities: of each installed strategy, selected or not, with its options for all.
    """

    reads: tuple[str, ...] = ()
    options_of: Callable[[str, ProcessSpec], Any] = no_options
    executors: Mapping[str, frozenset[str]] = field(default_factory=lambda: EMPTY)
    brought_by: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    capabilities_of: Callable[[ProcessSpec], Capabilities] = no_capabilities
    capabilities: Mapping[str, Capabilities] = field(default_factory=lambda: EMPTY)

    def has_snapshots(self, spec: ProcessSpec) -> bool:
        """Return True if the node of a process publishes a state of which snapshots are kept."""
        return bool(spec.ros) and self.capabilities_of(spec).state == "topics"
