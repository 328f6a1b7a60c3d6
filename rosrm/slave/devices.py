"""Devices of this host: those of its settings and those that its probes find."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import describe_fault
from rosrm.model.devices import MOST_DEVICES, Device
from rosrm.runtime.path_calls import PathCall, RunPath
from rosrm.runtime.path_calls import at as touching
from rosrm.shortage import raise_unless_absent
from rosrm.slave.sampler import Finding
from rosrm.wording import listed, reason_of, sanitized

_log = logging.getLogger("rosrm.slave")

#: Seconds between two looks at the devices.
LOOK_PERIOD: Final = 1.0
#: Least seconds between the two measurements after which a missing device is lost.
_LASTS: Final = 0.9 * LOOK_PERIOD

#: A device, and when it was measured; None: it is not known to be missing.
_Measured = tuple[Device, float | None]
_Units = Mapping[str, tuple[Device, float]]
#: Returns the fault of a file ("": it is there), and when that was measured.
FaultOf = Callable[[str], tuple[str, float]]
_UNMEASURED: Final = ("", 0.0)


def file_fault(path: str) -> str:
    """Return why the file of a device is not there; "": it is.

    Raises:
        OSError: the look was not made, such as without a free file descriptor.
    """
    try:
        touching(path)
        Path(path).stat()
    except OSError as error:
        raise_unless_absent(error)
        return f"{path}: {reason_of(error)}"
    return ""


class FileFaults:
    """Faults of the files of devices, checked in a thread, because a file may not answer.

    After a look that was not made the last fault stays, because the end of a process that holds
    the device follows from a fault.

    Args:
        run: as `PathCalls.run`.
        changed: called in the loop after a fault has changed.
        clock: of the measurements.
    """

    def __init__(
        self, run: RunPath, changed: Callable[[], None],
        clock: Callable[[], float] = clocks.boot_time,
    ) -> None:  # fmt: skip
        self._run, self._changed, self._clock = run, changed, clock
        self._faults: dict[str, tuple[str, float]] = {}
        self._looks: dict[str, PathCall] = {}
        self._unknown: set[str] = set()

    def __call__(self, path: str) -> tuple[str, float]:
        """Return the newest known fault of a file with its time, and begin to look again."""
        if path not in self._looks or self._looks[path].has_ended:
            seen = partial(self._seen, path, self._clock())
            self._looks[path] = self._run(
                partial(file_fault, path), seen, partial(self._missed, path)
            )
        return self._faults.get(path, _UNMEASURED)

    def _seen(self, path: str, at: float, fault: str) -> None:
        before, _ = self._faults.get(path, _UNMEASURED)
        self._faults[path] = fault, at
        self._unknown.discard(path)
        if fault != before:
            self._changed()

    def _missed(self, path: str, error: Exception) -> None:
        if path not in self._unknown:
            last, _ = self._faults.get(path, _UNMEASURED)
            _log.info(
                "device file %s: not checked, so the last state stays (%s): %s",
                path, last or "it is there", describe_fault(error),
            )  # fmt: skip
        self._unknown.add(path)


class DeviceWatch:
    """Watch on the devices of this host.

    Args:
        configured: devices by kind; for these kinds they replace what the probes find.

    Attributes:
        configured: as the argument; a reload replaces them.
        devices: all devices, as at the last look.
        lost: kind and unit of each device that was missing in two measurements a look apart and
            since then, to the reason; a device may be missing for a moment, such as while its
            driver starts again.
    """

    def __init__(self, configured: Mapping[str, tuple[Device, ...]]) -> None:
        self.configured = configured
        self.devices: tuple[Device, ...] = ()
        self.lost: Mapping[tuple[str, str], str] = {}
        self._since: dict[tuple[str, str], float] = {}

    def look(self, found: Mapping[str, Finding], awaits: bool, fault_of: FaultOf) -> bool:
        """Look at each device once, and log changes; return True if there are any.

        Args:
            found: name of each probe to the devices that it found last.
            awaits: True if another probe may find devices, but has not answered yet.
            fault_of: returns the fault of a file.
        """
        measured = tuple(self._all(found, awaits, fault_of))[:MOST_DEVICES]
        before, self.devices = self.devices, tuple(device for device, _ in measured)
        _log_changes(self.devices, {(one.kind, one.unit) for one in before if one.missing})
        since, lost = self._since, {}
        self._since = {}
        for one, at in measured:
            key = one.kind, one.unit
            if one.missing and at is not None:
                self._since[key] = since.get(key, at)
                if at - self._since[key] >= _LASTS:
                    lost[key] = one.missing
        self.lost = lost
        return self.devices != before

    def _all(
        self, found: Mapping[str, Finding], awaits: bool, fault_of: FaultOf
    ) -> Iterator[_Measured]:
        by_kind: dict[str, dict[str, tuple[Device, float]]] = {}
        for devices, at in found.values():
            for device in devices:
                by_kind.setdefault(device.kind, {}).setdefault(device.unit, (device, at))
        for kind, configured in self.configured.items():
            joined = (_joined(one, by_kind.get(kind), awaits) for one in configured)
            yield from _checked(joined, fault_of)
        for kind, units in by_kind.items():
            if kind not in self.configured:
                yield from _checked(units.values(), fault_of)


def _log_changes(devices: Iterable[Device], missing: AbstractSet[tuple[str, str]]) -> None:
    for one in devices:
        was_missing = (one.kind, one.unit) in missing
        if one.missing and not was_missing:
            _log.info("%s is missing, so no process gets it: %s", one.title, one.missing)
        elif was_missing and not one.missing:
            _log.info("%s is there again", one.title)


def _joined(device: Device, found: _Units | None, awaits: bool) -> _Measured:
    """Return a device of the settings with what a probe of its kind tells about it."""
    if found is None:
        return device, None
    if device.unit not in found:
        missing = replace(device, missing=f"no probe finds it; found: {listed(found)}")
        return missing, None if awaits else min(at for _, at in found.values())
    other, at = found[device.unit]
    path = device.path or other.path
    return replace(device, path=path, about=other.about, missing=other.missing), at


def _checked(devices: Iterable[_Measured], fault_of: FaultOf) -> Iterator[_Measured]:
    """Yield the devices; one whose file is not there is missing."""
    for device, at in devices:
        if device.missing:
            yield replace(device, missing=sanitized(device.missing)), at
        elif device.path:
            fault, looked = fault_of(device.path)
            yield (replace(device, missing=sanitized(fault)), looked) if fault else (device, at)
        else:
            yield device, at
