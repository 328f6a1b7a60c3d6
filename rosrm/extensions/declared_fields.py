"""Declarations of the selected plugins' offers, and the view of a spec for a policy or filter.

Processes with equal demands share one ranking. So a scoring policy or a filter may read only the
fields by which demands are compared: the standard ones, and those that its offer declares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from operator import is_
from types import MappingProxyType
from typing import Any, Final, TypeVar, cast, get_args, get_origin, get_type_hints

from rosrm.extensions.contracts import Capabilities
from rosrm.model.values import EMPTY, ProcessSpec
from rosrm.wording import listed

T = TypeVar("T")

#: Fields of a spec that every policy may read, because `Demand.key` includes them.
STANDARD_FIELDS: Final = (
    "package", "executable", "module", "command", "namespace", "kind", "priority", "needs",
    "required_labels", "preferred_labels", "avoided_labels", "limits", "cpus", "realtime", "nice",
    "devices", "container",
)  # fmt: skip
#: Field that gives the policy the flows of the process, also the learned ones.
FLOWS_FIELD: Final = "talks_to"
#: All fields of a spec, which an offer may declare; `given` is of use at the submission only.
SPEC_FIELDS: Final = tuple(f.name for f in fields(ProcessSpec) if f.name != "given")


class UndeclaredField(LookupError):
    """A policy or filter reads a field of a spec that its offer does not declare.

    Not an AttributeError, because `getattr` with a default would silently return a wrong value.
    """


class DeclaredSpec:
    """A read-only spec that gives a plugin the standard fields and the declared ones, no others."""

    __slots__ = ("_reads", "_spec")

    def __init__(self, spec: ProcessSpec, reads: tuple[str, ...]) -> None:
        self._spec = spec
        self._reads = reads

    def __getattr__(self, name: str) -> Any:
        if name in STANDARD_FIELDS or name in self._reads:
            value = getattr(self._spec, name)
            return MappingProxyType(value) if isinstance(value, dict) else value
        if name in SPEC_FIELDS:
            raise UndeclaredField(
                f"the plugin reads {name!r} of the spec, which its offer does not declare: "
                f"add reads={(*self._reads, name)!r} to the offer"
            )
        derived = getattr(ProcessSpec, name, None)
        if isinstance(derived, property) and derived.fget is not None:
            return derived.fget(self)
        raise AttributeError(f"a spec has no field {name!r}; it has {', '.join(SPEC_FIELDS)}")

    def __repr__(self) -> str:
        shown = (f for f in SPEC_FIELDS if f in STANDARD_FIELDS or f in self._reads)
        return f"DeclaredSpec({', '.join(f'{f}={getattr(self._spec, f)!r}' for f in shown)})"


def declared_spec(spec: ProcessSpec, reads: tuple[str, ...]) -> ProcessSpec:
    """Return the view of a spec for a plugin that declares these fields."""
    return cast(ProcessSpec, DeclaredSpec(spec, reads))


def unshared(value: T) -> T:
    """Return a value with copies of all mappings and lists, so that a plugin may change them."""
    return cast(T, _unshared(value))


def _unshared(value: Any) -> Any:
    kind = type(value)
    if kind is dict:
        return {key: _unshared(item) for key, item in value.items()}
    if kind is list:
        return list(map(_unshared, value))
    if kind is tuple:
        made = tuple(map(_unshared, value))
        return value if all(map(is_, made, value)) else made
    if not is_dataclass(kind):
        return value
    changed = {}
    for name in _changeable(kind):
        item = getattr(value, name)
        copied = _unshared(item)
        if copied is not item:
            changed[name] = copied
    return replace(value, **changed) if changed else value


@cache
def _changeable(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields that hold a mapping or list, or a value with one."""
    hints = get_type_hints(kind)
    return tuple(one.name for one in fields(kind) if _may_change(hints[one.name]))


def _may_change(hint: Any) -> bool:
    origin = get_origin(hint) or hint
    if origin is Any or (isinstance(origin, type) and issubclass(origin, Mapping | list)):
        return True
    if isinstance(origin, type) and is_dataclass(origin):
        return bool(_changeable(origin))
    return any(map(_may_change, get_args(hint)))


@dataclass(frozen=True, slots=True)
class UnknownCapabilities:
    """A strategy has not told its capabilities for a process, which may have state or a launcher.

    Attributes:
        reason: a sentence.
    """

    reason: str


def unknown_capabilities(strategy: str, why: object) -> UnknownCapabilities:
    """Return the value for a strategy that gives no answer."""
    return UnknownCapabilities(
        f"the capabilities of its migration strategy {strategy!r} are not known: {why}"
    )


#: Capabilities of a strategy for one process, if they are known.
MaybeCapabilities = Capabilities | UnknownCapabilities


def no_options(_strategy: str, _spec: ProcessSpec) -> Any:
    """Return None, because no offer declares the options of a strategy."""
    return None


def no_capabilities(_spec: ProcessSpec) -> Capabilities:
    """Return the default capabilities, because no offer declares any."""
    return Capabilities()


def standby_conflict(
    spec: ProcessSpec, able: MaybeCapabilities, known: Mapping[str, Capabilities]
) -> str:
    """Return why a process cannot have its standby; "": it can, or requests none.

    Args:
        spec: of the process.
        able: capabilities of its strategy.
        known: those of all strategies, for the remedy.
    """
    if not spec.standby.wanted:
        return ""
    if isinstance(able, UnknownCapabilities):
        return able.reason
    return "" if able.shadow else _no_standby(spec.migration.strategy, known)


def _no_standby(strategy: str | None, known: Mapping[str, Capabilities]) -> str:
    able = [f"`migration: {name}`" for name, it in known.items() if it.shadow]
    why = f"{strategy} has no standby" if strategy else "no migration strategy is given"
    remedy = f"write {listed(able, 'or')}" if able else "install a strategy with standbys"
    return f"a standby needs a migration strategy that copies state, and {why}: {remedy}"


def container_conflict(spec: ProcessSpec, able: MaybeCapabilities) -> str:
    """Return why a process in a container cannot move by a strategy; "": it can, or has none."""
    if not spec.container.image:
        return ""
    if isinstance(able, UnknownCapabilities):
        return able.reason
    if able.state == "none" and not able.launcher:
        return ""
    return (
        f"{spec.migration.strategy} moves the state of a process, which is not possible with a "
        "container; write a strategy that starts the process again, such as relaunch"
    )


@dataclass(frozen=True)
class Declared:
    """Declarations of the selected plugins' offers.

    Attributes:
        options_of: returns the options of a strategy for a spec, merged and parsed; raises
            `ValueError` for an option that the strategy does not accept.
        executors: strategy to the names of its executors, for known offers.
        brought_by: strategy to its distribution, if known.
        capabilities_of: returns the capabilities of the strategy of a process; never raises.
        capabilities: each installed strategy, selected or not, to its capabilities with the options
            of the cluster, if they are known.
    """

    options_of: Callable[[str, ProcessSpec], Any] = no_options
    executors: Mapping[str, frozenset[str]] = field(default_factory=lambda: EMPTY)
    brought_by: Mapping[str, str] = field(default_factory=lambda: EMPTY)
    capabilities_of: Callable[[ProcessSpec], MaybeCapabilities] = no_capabilities
    capabilities: Mapping[str, Capabilities] = field(default_factory=lambda: EMPTY)

    def may_have_snapshots(self, spec: ProcessSpec) -> bool:
        """Return False if the node of a process publishes no state that is stored in snapshots.

        With unknown capabilities it may: what is done for snapshots that do not exist does no harm.
        """
        if not spec.ros:
            return False
        able = self.capabilities_of(spec)
        return isinstance(able, UnknownCapabilities) or able.state == "topics"
