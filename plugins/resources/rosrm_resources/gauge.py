"""Gauges of one resource by scope, and the probe that reads a gauge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, Protocol

from rosrm import Accounting, ConfigError, ProbeContext, Reading, ResourceDescription

#: Scope of a measurement: the whole machine; the control group of the slave (for containers); or
#: the slave's own process tree against a budget.
Scope = Literal["machine", "cgroup", "slice"]

#: Largest reported usage. A small budget can be exceeded a hundredfold, and a larger number would
#: add no information.
OVERFULL: Final = 10.0


class Gauge(Protocol):
    """Measurement of one resource in one scope."""

    @property
    def scope(self) -> str:
        """Return the effective scope: an unlimited cgroup counts as the machine."""

    @property
    def capacity(self) -> float:
        """Return the base units that correspond to usage 1.0."""

    def usage(self) -> float:
        """Return the fraction of the capacity in use now."""

    def close(self) -> None:
        """Close the files."""


class GaugeProbe:
    """Probe of one resource.

    Args:
        name: of the resource.
        unit: base unit of the capacity.
        gauge: measures the resource.
        accounting: of the resource.
    """

    def __init__(self, name: str, unit: str, gauge: Gauge, accounting: Accounting) -> None:
        self._name = name
        self._gauge = gauge
        self._resources = (
            ResourceDescription(name, unit, gauge.capacity, gauge.scope, accounting),
        )

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return the only resource."""
        return self._resources

    def read(self) -> Sequence[Reading]:
        """Return the current usage."""
        return (Reading(self._name, min(self._gauge.usage(), OVERFULL)),)

    def close(self) -> None:
        """Close the gauge's files."""
        self._gauge.close()


def check_group(group: str | None, scope: Scope | None) -> None:
    """Raise `ValueError` if the option `group` of a probe does not fit its `scope`."""
    if group is not None and scope not in (None, "cgroup"):
        raise ValueError(f"group: goes with the scope 'cgroup', not with {scope!r}")
    if group is not None and not group.startswith("/"):
        raise ValueError(f"group: {group!r} does not begin with '/'")


def budget(context: ProbeContext, resource: str, unit: str) -> float:
    """Return the budget of the host's slice for a resource.

    Raises:
        ConfigError: the budget is not set, or not above 0.
    """
    amount = context.budget.get(resource)
    if amount is None:
        raise ConfigError(
            f"probe {resource}: the scope 'slice' needs a budget for {resource!r} in {unit}; "
            f"budgets are set for: {', '.join(sorted(context.budget)) or 'nothing'}"
        )
    if not amount > 0:
        raise ConfigError(f"probe {resource}: budget {amount:g} {unit}; it must be above 0")
    return amount
