"""Devices of the hosts, and the instances that hold them.

The inventory of a host never changes; each change replaces it. So a decision keeps the inventories
on which it was made, and formats its reasons when they are read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from rosrm.core.master.state.host_arrays import IntArray
from rosrm.model.devices import Device, DeviceNeed, HeldDevice, title_of
from rosrm.model.values import InstanceId
from rosrm.wording import few, listed

#: Kind and unit of a device.
DeviceKey = tuple[str, str]
DeviceNeeds = tuple[DeviceNeed, ...]
#: Highest number of further processes that is counted for one host; a ranking looks no further.
COUNTED: Final = 8
#: Tolerance in comparisons of sums of shares.
_CLOSE: Final = 1e-9
#: Bounds of the cache: different needs, and changes of inventories that it has not seen.
_MOST_CACHED: Final = 256
_MOST_CHANGES: Final = 100_000


@dataclass(frozen=True, slots=True)
class Inventory:
    """Devices of one host.

    Attributes:
        devices: all devices of the host, in the order of its slave.
        held: instance to its devices; also to devices that are missing, or no longer there.
        free: device that is not missing to the share of it that no instance holds.
    """

    devices: tuple[Device, ...] = ()
    held: Mapping[InstanceId, tuple[HeldDevice, ...]] = field(default_factory=dict)
    free: Mapping[DeviceKey, float] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        free = {(one.kind, one.unit): 1.0 for one in self.devices if not one.missing}
        for one in (one for held in self.held.values() for one in held):
            if (one.kind, one.unit) in free:
                free[one.kind, one.unit] -= one.share
        object.__setattr__(self, "free", free)

    def emptied(self) -> Inventory:
        """Return the inventory as if no instance held a device."""
        return replace(self, held={}) if self.held else self

    def with_held(self, instance: InstanceId, held: tuple[HeldDevice, ...]) -> Inventory:
        """Return the inventory in which an instance holds these devices and no others."""
        others = {one: devices for one, devices in self.held.items() if one != instance}
        return replace(self, held={**others, instance: held} if held else others)

    def choose(self, needs: DeviceNeeds) -> tuple[HeldDevice, ...] | None:
        """Return free devices that meet the needs; None: there are not enough."""
        return self._choose(needs, dict(self.free))

    def after(self, needs: DeviceNeeds, times: int) -> Inventory:
        """Return the inventory after further processes with these needs have got devices."""
        found = self
        for number in range(times):
            held = found.choose(needs)
            if not held:
                break
            found = found.with_held(InstanceId("", number), held)
        return found

    def count(self, needs: DeviceNeeds) -> int:
        """Return for how many processes with these needs there are devices, at most COUNTED."""
        free = dict(self.free)
        return next((n for n in range(COUNTED) if self._choose(needs, free) is None), COUNTED)

    def _choose(
        self, needs: DeviceNeeds, free: dict[DeviceKey, float]
    ) -> tuple[HeldDevice, ...] | None:
        """Return devices that meet the needs, and take them from `free`."""
        chosen: list[HeldDevice] = []
        for need in sorted(needs, key=lambda need: not need.units):  # named units have no choice
            found = self._units(need, free)
            if found is None:
                return None
            for one in found:
                free[one.kind, one.unit] -= one.share
            chosen += found
        return tuple(chosen)

    def _units(self, need: DeviceNeed, free: Mapping[DeviceKey, float]) -> list[HeldDevice] | None:
        """Return units for one need: the fullest unit for a share, else the emptiest units."""
        fitting: list[tuple[float, HeldDevice]] = []
        for device in self.devices:
            if device.kind != need.kind or (need.units and device.unit not in need.units):
                continue
            share = need.amount if need.amount < 1.0 else 1.0 / device.shareable
            left = free.get((device.kind, device.unit))
            if left is not None and left + _CLOSE >= share:
                order = left if need.amount < 1.0 else -left
                fitting.append((order, HeldDevice(device.kind, device.unit, share)))
        many = max(1, int(need.amount))
        if len(fitting) < many:
            return None
        fitting.sort(key=lambda one: one[0])
        return [one for _, one in fitting[:many]]

    def free_by_kind(self) -> dict[str, float]:
        """Return each kind of the host's devices to the number of its free units."""
        free = {one.kind: 0.0 for one in self.devices}
        for (kind, _), share in self.free.items():
            free[kind] += max(share, 0.0)
        return free

    # --- reasons -------------------------------------------------------------------------

    def why_not(self, needs: DeviceNeeds) -> str:
        """Return why the devices do not meet the needs, as a predicate of the host."""
        for need in needs:
            if self.choose((need,)) is None:
                return self._why_not(need)
        asked = listed([f"{_asked(need)} of {need.kind}" for need in needs])
        return f"its devices do not suffice for {asked}"

    def _why_not(self, need: DeviceNeed) -> str:
        there = [one for one in self.devices if one.kind == need.kind]
        if not there:
            return f"it has no {need.kind}"
        units = {one.unit: one for one in there}
        for unit in need.units:
            if unit not in units:
                return f"it has no {title_of(need.kind, unit)} (there: {listed(list(units))})"
        wanted = [units[unit] for unit in need.units] or there
        states = [f"{one.title} {state}" for one in wanted if (state := self._state_of(one))]
        taken = "; ".join(few(states, 4)) or f"it has {len(there)}"
        return f"{need.kind}: needs {_asked(need)}; {taken}"

    def _state_of(self, device: Device) -> str:
        """Return why a device is not free, as a predicate; "": it is free."""
        if device.missing:
            return f"is missing: {device.missing}"
        holders = [str(one) for one in self.holders_of((device.kind, device.unit))]
        return f"is held by {listed(holders, most=3)}" if holders else ""

    def holders_of(self, key: DeviceKey) -> Iterator[InstanceId]:
        """Yield the instances that hold a device, whole or in part."""
        for instance, held in self.held.items():
            if any((one.kind, one.unit) == key for one in held):
                yield instance


def _asked(need: DeviceNeed) -> str:
    return listed(need.units) if need.units else f"{need.amount:g}"


_NONE: Final = Inventory()


@dataclass(slots=True)
class _Counts:
    """Cached counts.

    Attributes:
        of: (H,) number of processes for which each host has devices.
        seen: number of changes of inventories that the counts include.
    """

    of: IntArray
    seen: int


class DeviceTable:
    """Inventories of all hosts by column, with cached counts for the needs in use."""

    def __init__(self) -> None:
        self._inventories: list[Inventory] = []
        self._counts: dict[tuple[DeviceNeeds, bool], _Counts] = {}
        self._changed: list[int] = []

    def add_column(self) -> None:
        """Add a host without devices."""
        self._inventories.append(_NONE)
        self._forget()

    def _forget(self) -> None:
        self._counts.clear()
        self._changed.clear()

    def __getitem__(self, column: int) -> Inventory:
        return self._inventories[column]

    def __setitem__(self, column: int, inventory: Inventory) -> None:
        """Replace the inventory of a host."""
        self._inventories[column] = inventory
        self._changed.append(column)
        if len(self._changed) > _MOST_CHANGES:
            self._forget()

    def counts(self, needs: DeviceNeeds, *, empty: bool = False) -> IntArray:
        """Return for how many processes with these needs each host has devices, (H,).

        `empty`: as if no instance held a device.
        """
        known = self._counts.get((needs, empty))
        if known is None:
            if len(self._counts) >= _MOST_CACHED:
                self._forget()
            counts = self._count_all(needs, empty=empty)
            known = self._counts[needs, empty] = _Counts(counts, len(self._changed))
        for column in set(self._changed[known.seen :]):
            inventory = self._inventories[column]
            known.of[column] = (inventory.emptied() if empty else inventory).count(needs)
        known.seen = len(self._changed)
        return known.of

    def _count_all(self, needs: DeviceNeeds, *, empty: bool) -> IntArray:
        alike: dict[tuple[Device, ...], int] = {}  # most hosts of a cluster have equal devices
        found = np.zeros(len(self._inventories), np.int64)
        for column, inventory in enumerate(self._inventories):
            if inventory.held and not empty:
                found[column] = inventory.count(needs)
                continue
            if inventory.devices not in alike:
                alike[inventory.devices] = inventory.emptied().count(needs)
            found[column] = alike[inventory.devices]
        return found

    def at(self, columns: slice | IntArray) -> Sequence[Inventory]:
        """Return the inventories of some hosts; a slice has all hosts, with their later changes."""
        if isinstance(columns, slice):
            return self._inventories  # no copy, because it costs more than a filter
        return [self._inventories[column] for column in columns.tolist()]

    def kinds(self) -> list[str]:
        """Return the kinds of devices that any host offers."""
        return sorted({one.kind for inventory in self._inventories for one in inventory.devices})
