"""Options of a migration strategy for one process, merged over those of the cluster.

This module does not import pydantic, because the master merges options for each migration.
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
    """Return the options for one process, as in `Move.options`.

    Args:
        spec: its `migration.options` are unparsed, as in the work file, because the client may lack
            the plugin that knows their units.
        cluster: the strategy's options for all processes.
        own: type of the options of one process, if it differs from that of `cluster`.

    Raises:
        ValueError: for an unknown option, or an invalid value.
    """
    wanted, given = own or type(cluster), spec.migration.options
    if not given and wanted is type(cluster):
        return cluster
    return merged_options(wanted, to_plain(cluster), given)


def merged_options(wanted: type[T], cluster: Mapping[str, Any], own: Mapping[str, Any]) -> T:
    """Return checked options of a type: those of the cluster, overridden by unparsed own ones.

    Raises:
        ValueError: as `options_of`.
    """
    return from_plain(wanted, {**cluster, **_in_base_units(wanted, own)})


def _in_base_units(wanted: type[Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options with numbers instead of text such as "5s"; refuse values out of range."""
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
