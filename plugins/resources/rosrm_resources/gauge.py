"""What the probes of one resource have in common: a gauge, chosen by the scope."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, Protocol

from rosrm import ConfigError, ProbeContext, Reading, ResourceDescription

#: What is measured: the whole machine; the control group the slave runs in (what a container
#: needs); or the slave's own process tree against a budget.
Scope = Literal["machine", "cgroup", "slice"]

#: A small budget can be exceeded a hundred times over; above this the number tells no more.
OVERFULL: Final = 10.0


class Gauge(Protocol):
    """Measures one resource in one scope."""

    @property
    def scope(self) -> str:
        """What is measured in the end: an unlimited cgroup counts as the machine."""

    @property
    def capacity(self) -> float:
        """Base units that usage 1.0 stands for."""

    def usage(self) -> float:
        """Fraction of the capacity in use now."""

    def close(self) -> None:
        """Release the files."""


class GaugeProbe:
    """A probe of one resource.

    Args:
        name: of the resource.
        unit: base unit of the capacity.
        gauge: what measures it.
    """

    def __init__(self, name: str, unit: str, gauge: Gauge) -> None:
        self._name = name
        self._gauge = gauge
        self._resources = (ResourceDescription(name, unit, gauge.capacity, gauge.scope),)

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """The one resource."""
        return self._resources

    def read(self) -> Sequence[Reading]:
        """Its usage now."""
        return (Reading(self._name, min(self._gauge.usage(), OVERFULL)),)

    def close(self) -> None:
        """Release the gauge's files."""
        self._gauge.close()


def check_group(group: str | None, scope: Scope | None) -> None:
    """Raise `ValueError` where the option `group` of a probe does not go with its `scope`."""
    if group is not None and scope not in (None, "cgroup"):
        raise ValueError(f"group: goes with the scope 'cgroup', not with {scope!r}")
    if group is not None and not group.startswith("/"):
        raise ValueError(f"group: {group!r} does not begin with '/'")


def budget(context: ProbeContext, resource: str, unit: str) -> float:
    """What the host's slice may use of a resource.

    Raises:
        ConfigError: it is not set, or not above 0.
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
