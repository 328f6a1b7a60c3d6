"""Annotations of devices, which a file gives as numbers, names or paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, Any, Final

from rosrm.model.devices import Device, DeviceNeed

_SHAREABLE: Final = "shareable"


@dataclass(frozen=True)
class AskedDevices:
    """Annotation of the devices of one kind that a process asks for; the kind is set later."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that reads a number, a name or a list of names."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_plain_validator_function(self.read)

    @staticmethod
    def read(given: Any) -> DeviceNeed:
        """Return the need in a file; raise `ValueError`, but not for a number out of range."""
        if isinstance(given, (int, float)) and not isinstance(given, bool):
            try:
                return DeviceNeed("", float(given))
            except OverflowError:
                return DeviceNeed("", inf)
        units = given if isinstance(given, list) and given else [given]
        if not all(map(_is_name, units)):
            raise ValueError(
                f"{given!r}: a number such as 1 or 0.5, the name of a unit or a list of names is "
                "required"
            )
        return DeviceNeed("", float(len(units)), tuple(map(str, units)))


@dataclass(frozen=True)
class OfferedDevices:
    """Annotation of the devices of one kind on a host; the kind is set later."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that reads a list of units, a mapping of units to paths, or a path."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_plain_validator_function(self.read)

    @staticmethod
    def read(given: Any) -> tuple[Device, ...]:
        """Return the devices in a file; a unit without a name gets that of its kind later."""
        if isinstance(given, list) and all(map(_is_name, given)):
            return tuple(Device("", str(unit)) for unit in given)
        if isinstance(given, str):
            return (Device("", "", given),)
        if isinstance(given, Mapping):
            return _units_of(given)
        raise ValueError(
            f"{given!r}: a list of units such as [0, 1], a mapping such as "
            "{front: /dev/video0} or {shareable: 4}, or a path is required"
        )


#: Section `devices` of a process, and of a host.
AskedByKind = Mapping[str, Annotated[DeviceNeed, AskedDevices()]]
OfferedByKind = Mapping[str, Annotated[tuple[Device, ...], OfferedDevices()]]


def with_kinds(devices: Mapping[str, tuple[Device, ...]]) -> dict[str, tuple[Device, ...]]:
    """Return devices with their kinds; a unit without a name gets that of its kind."""
    return {
        kind: tuple(replace(one, kind=kind, unit=one.unit or kind) for one in units)
        for kind, units in devices.items()
    }


def _units_of(given: Mapping[str, Any]) -> tuple[Device, ...]:
    shareable = given.get(_SHAREABLE, 1)
    if isinstance(shareable, int) and not isinstance(shareable, bool):
        units = {unit: path for unit, path in given.items() if unit != _SHAREABLE} or {"": ""}
        wrong = [path for path in units.values() if not isinstance(path, (str, type(None)))]
        if wrong:
            raise ValueError(f"{wrong[0]!r}: the path of a device is required, as /dev/video0")
        return tuple(Device("", unit, path or "", shareable) for unit, path in units.items())
    raise ValueError(f"{_SHAREABLE}: a whole number of processes is required, not {shareable!r}")


def _is_name(given: object) -> bool:
    return isinstance(given, (str, int)) and not isinstance(given, bool)
