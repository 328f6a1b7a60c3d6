"""A process's own options of a migration strategy, merged over those of the cluster.

Imports no pydantic: the master merges them for each move.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, get_type_hints, overload

from rosrm.extensions.units import Quantity
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.values import ProcessSpec

T = TypeVar("T")
Own = TypeVar("Own")


@overload
def options_of(spec: ProcessSpec, cluster: T) -> T: ...


@overload
def options_of(spec: ProcessSpec, cluster: Any, own: type[Own]) -> Own: ...


def options_of(spec: ProcessSpec, cluster: Any, own: type[Any] | None = None) -> Any:
    """Return the options that hold for one process, as `Move.options` has them.

    Args:
        spec: its `migration.options` are given by name, as the work file has them: who submits it
            may have no plugin that knows what is measured by them.
        cluster: the strategy's options for all processes.
        own: those that one process may have, where they are more.

    Raises:
        ValueError: for an unknown option, or a value that makes no sense.
    """
    wanted, given = own or type(cluster), spec.migration.options
    if not given and wanted is type(cluster):
        return cluster
    return merged_options(wanted, to_plain(cluster), given)


def merged_options(wanted: type[T], cluster: Mapping[str, Any], own: Mapping[str, Any]) -> T:
    """Return options of a type from those of the cluster, checked, and a process's own, as text.

    Raises:
        ValueError: as `options_of`.
    """
    return from_plain(wanted, {**cluster, **_in_base_units(wanted, own)})


def _in_base_units(wanted: type[Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """With a number for "5s" and the like; what is out of its range is refused."""
    hints = get_type_hints(wanted, include_extras=True) if given else {}
    return {name: _number(name, hints.get(name), value) for name, value in given.items()}


def _number(name: str, hint: Any, value: Any) -> Any:
    for mark in getattr(hint, "__metadata__", ()):
        if isinstance(mark, Quantity) and isinstance(value, (str, int, float)):
            try:
                return mark.parse(value)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
    return value
