"""Devices: units of hardware that a host gives to its processes, whole or in shares."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

#: Highest number of devices of a host, and of units that a process may ask for.
MOST_DEVICES: Final = 256
#: Highest number of processes to which one unit may be given, and its smallest share.
MOST_SHARING: Final = 1000
_SMALLEST: Final = 1.0 / MOST_SHARING
#: Kind of the devices that CUDA knows by their index.
GPU: Final = "gpu"

_KIND: Final = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
_UNIT: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_LONGEST_TEXT: Final = 4096


@dataclass(frozen=True, slots=True)
class DeviceNeed:
    """Devices of one kind that a process asks for.

    Attributes:
        kind: kind of the devices: "gpu", "camera".
        amount: number of units; below 1: share of one unit.
        units: names of the units; (): any units.
    """

    kind: str
    amount: float = 1.0
    units: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Device:
    """One unit of a kind of devices on a host.

    Attributes:
        kind: kind of the device: "gpu", "camera".
        unit: name, unique among the units of this kind on the host.
        path: file of the device; "": it has none.
        shareable: highest number of processes to which the unit is given at the same time.
        about: description for users, such as the model.
        missing: why the unit cannot be given now; "": it can.
    """

    kind: str
    unit: str
    path: str = ""
    shareable: int = 1
    about: str = ""
    missing: str = ""

    @property
    def title(self) -> str:
        """Return kind and unit: "camera front"."""
        return title_of(self.kind, self.unit)


@dataclass(frozen=True, slots=True)
class HeldDevice:
    """A unit that an instance holds, whole or in part.

    Attributes:
        kind, unit: of the device.
        share: part of the unit that the instance takes, above 0 and at most 1.
    """

    kind: str
    unit: str
    share: float = 1.0

    def __str__(self) -> str:
        of = "" if self.share >= 1.0 else f"{self.share:.3g} of "
        return of + title_of(self.kind, self.unit)


def title_of(kind: str, unit: str) -> str:
    """Return kind and unit of a device for users; a single unit has the name of its kind."""
    return kind if unit == kind else f"{kind} {unit}"


def need_fault(needs: Iterable[DeviceNeed]) -> str:
    """Return why a process cannot ask for these devices; "": it can."""
    kinds = set()
    for need in needs:
        if not _KIND.fullmatch(need.kind):
            return f"{need.kind!r:.100} cannot be a kind of devices. Allowed: {_ALLOWED}"
        if need.kind in kinds:
            return f"{need.kind} is given twice"
        kinds.add(need.kind)
        wrong = next((unit for unit in need.units if not _UNIT.fullmatch(unit)), None)
        if wrong is not None:
            return f"{need.kind}: {wrong!r:.100} cannot be a unit. Allowed: {_ALLOWED_UNIT}"
        if len(set(need.units)) < len(need.units):
            return f"{need.kind}: a unit is given twice: {', '.join(need.units)}"
        if need.units and need.amount != len(need.units):
            return f"{need.kind}: {need.amount:g} of {len(need.units)} named units are required"
        if not _SMALLEST <= need.amount <= MOST_DEVICES:  # also where it is NaN
            return f"{need.kind}: {need.amount} is not within {_SMALLEST:g}..{MOST_DEVICES}"
        if need.amount > 1.0 and need.amount != int(need.amount):
            return (
                f"{need.kind}: {need.amount:g} is neither a whole number of units nor a share of "
                "one unit, below 1"
            )
    return ""


def device_fault(devices: Iterable[Device]) -> str:
    """Return why a host cannot have these devices; "": it can."""
    known = set()
    for device in devices:
        kind: object = device.kind
        unit: object = device.unit
        if not (isinstance(kind, str) and _KIND.fullmatch(kind)):
            return f"{kind!r:.100} cannot be a kind of devices. Allowed: {_ALLOWED}"
        if not (isinstance(unit, str) and _UNIT.fullmatch(unit)):
            return f"{kind}: {unit!r:.100} cannot be a unit. Allowed: {_ALLOWED_UNIT}"
        if (device.kind, device.unit) in known:
            return f"{device.title} is given twice"
        known.add((device.kind, device.unit))
        if device.path and not device.path.startswith("/"):
            return f"{device.title}: {device.path!r:.200} is no absolute path, such as /dev/video0"
        for text in (device.path, device.about, device.missing):
            if not text.isprintable() or len(text) > _LONGEST_TEXT:
                return f"{device.title}: {text!r:.200} is no printable text"
        many: object = device.shareable
        if type(many) is not int or not 1 <= many <= MOST_SHARING:
            return f"{device.title}: shareable is {many!r}; allowed: 1 to {MOST_SHARING}"
    if len(known) > MOST_DEVICES:
        return f"{len(known)} devices; at most {MOST_DEVICES}"
    return ""


def held_fault(held: Iterable[HeldDevice]) -> str:
    """Return the fault of a message about the devices of an instance; "": none."""
    for one in held:
        if not (_KIND.fullmatch(one.kind) and _UNIT.fullmatch(one.unit)):
            return f"{one.kind!r:.100} {one.unit!r:.100} is no device"
        if not 0.0 < one.share <= 1.0:
            return f"its share of {title_of(one.kind, one.unit)} is {one.share}"
    return ""


_ALLOWED: Final = "at most 64 letters, digits, '_', '-' and '.', the first of them a letter"
_ALLOWED_UNIT: Final = _ALLOWED.replace("a letter", "a letter, digit or '_'")


# --- what a process gets ----------------------------------------------------------------------

#: Beginning of the variables with the devices of a process: `ROSRM_DEVICE_CAMERA`.
DEVICE_VARIABLE: Final = "ROSRM_DEVICE_"


def device_values(held: Iterable[HeldDevice], devices: Iterable[Device]) -> dict[str, str]:
    """Return the kind of each held device to its value for the process.

    The value is the path of the unit, or the name of a unit without a path; several units are
    separated by commas.
    """
    paths = {(one.kind, one.unit): one.path for one in devices}
    found: dict[str, str] = {}
    for one in held:
        value = paths.get((one.kind, one.unit)) or one.unit
        found[one.kind] = f"{found[one.kind]},{value}" if one.kind in found else value
    return found


def device_environment(held: Iterable[HeldDevice], values: Mapping[str, str]) -> dict[str, str]:
    """Return the variables by which a process knows its devices."""
    names = {
        DEVICE_VARIABLE + re.sub("[^A-Z0-9]", "_", kind.upper()): value
        for kind, value in values.items()
    }
    gpus = [one.unit for one in held if one.kind == GPU]
    if gpus:
        # By default CUDA counts the fastest GPU first, but the driver's index is by the bus.
        names |= {"CUDA_DEVICE_ORDER": "PCI_BUS_ID", "CUDA_VISIBLE_DEVICES": ",".join(gpus)}
    return names
