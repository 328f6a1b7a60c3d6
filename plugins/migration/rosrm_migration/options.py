"""A process's own options of a strategy, over those of the cluster."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, TypeVar, get_type_hints, overload

from rosrm.config.plain import from_plain, to_plain
from rosrm.config.units import Quantity
from rosrm.core.model import ProcessSpec

T = TypeVar("T")
Own = TypeVar("Own")


@overload
def options_of(spec: ProcessSpec, cluster: T) -> T: ...


@overload
def options_of(spec: ProcessSpec, cluster: Any, own: type[Own]) -> Own: ...


def options_of(spec: ProcessSpec, cluster: Any, own: type[Any] | None = None) -> Any:
    """What holds for one process.

    Args:
        spec: its `migration.options` are given by name, as the work file has them: who submits it
            may have no plugin that knows what is measured by them.
        cluster: the strategy's options for all processes.
        own: those that one process may have, where they are more.

    Raises:
        ValueError: for an unknown option, or a value that makes no sense.
    """
    given = spec.migration.options
    wanted = own or type(cluster)
    if not given and wanted is type(cluster):
        return cluster
    return from_plain(wanted, {**to_plain(cluster), **_in_base_units(wanted, given)})


def _in_base_units(wanted: type[Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """With a number for "5s" and the like."""
    hints = get_type_hints(wanted, include_extras=True)
    return {name: _number(name, hints.get(name), value) for name, value in given.items()}


def _number(name: str, hint: Any, value: Any) -> Any:
    for mark in getattr(hint, "__metadata__", ()):
        if isinstance(mark, Quantity) and isinstance(value, str):
            try:
                return mark.parse(value)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
    return value


def check_seconds(options: Any, *names: str) -> None:
    """Raise `ValueError` for a wait that is no time."""
    for name in names:
        seconds = getattr(options, name)
        if not 0.0 < seconds < inf:
            raise ValueError(f"{name} is {seconds:g} s; allowed: more than 0")
