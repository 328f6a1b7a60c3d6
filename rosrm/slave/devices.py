"""Devices of this host: those of its settings and those that its probes find."""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.errors import describe_fault
from rosrm.model.devices import MOST_DEVICES, Device
from rosrm.runtime.path_calls import PathCall, RunPath, at
from rosrm.wording import listed, reason_of, sanitized

_log = logging.getLogger("rosrm.slave")

#: Seconds between two looks at the devices.
LOOK_PERIOD: Final = 1.0

#: Errors of a file that is not there. After any other error, the look was not made.
_ABSENT: Final = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ENODEV, errno.ENXIO})

_Units = Mapping[str, Device]


def file_fault(path: str) -> str:
    """Return why the file of a device is not there; "": it is.

    Raises:
        OSError: the look was not made, such as without a free file descriptor.
    """
    try:
        at(path)
        Path(path).stat()
    except OSError as error:
        if error.errno not in _ABSENT:
            raise
        return f"{path}: {reason_of(error)}"
    return ""


class FileFaults:
    """Faults of the files of devices, checked in a thread, because a file may not answer.

    After a look that was not made the last fault stays, because the end of a process that holds
    the device follows from a fault.

    Args:
        run: as `PathCalls.run`.
        changed: called in the loop after a fault has changed.
    """

    def __init__(self, run: RunPath, changed: Callable[[], None]) -> None:
        self._run, self._changed = run, changed
        self._faults: dict[str, str] = {}
        self._looks: dict[str, PathCall] = {}
        self._unknown: set[str] = set()

    def __call__(self, path: str) -> str:
        """Return the newest known fault of a file, and begin to look at the file again."""
        if path not in self._looks or self._looks[path].has_ended:
            self._looks[path] = self._run(
                partial(file_fault, path), partial(self._seen, path), partial(self._missed, path)
            )
        return self._faults.get(path, "")

    def _seen(self, path: str, fault: str) -> None:
        before = self._faults.get(path, "")
        self._faults[path] = fault
        self._unknown.discard(path)
        if fault != before:
            self._changed()

    def _missed(self, path: str, error: Exception) -> None:
        if path not in self._unknown:
            _log.info(
                "device file %s: not checked, so the last state stays (%s): %s",
                path, self._faults.get(path) or "it is there", describe_fault(error),
            )  # fmt: skip
        self._unknown.add(path)


class DeviceWatch:
    """Watch on the devices of this host.

    Args:
        configured: devices by kind; for these kinds they replace what the probes find.

    Attributes:
        configured: as the argument; a reload replaces them.
        devices: all devices, as at the last look.
        lost: kind and unit of each device that was missing in the last two looks, to the reason;
            a device may be missing for a moment, such as while its driver starts again.
    """

    def __init__(self, configured: Mapping[str, tuple[Device, ...]]) -> None:
        self.configured = configured
        self.devices: tuple[Device, ...] = ()
        self.lost: Mapping[tuple[str, str], str] = {}

    def look(self, found: Mapping[str, tuple[Device, ...]], fault_of: Callable[[str], str]) -> bool:
        """Look at each device once, and log changes; return True if there are any.

        Args:
            found: name of each probe to the devices that it found last.
            fault_of: returns the fault of a file; "": it is there.
        """
        before, self.devices = self.devices, tuple(self._all(found, fault_of))[:MOST_DEVICES]
        missing = {(one.kind, one.unit) for one in before if one.missing}
        _log_changes(self.devices, missing)
        self.lost = {
            key: one.missing
            for one in self.devices
            if one.missing and (key := (one.kind, one.unit)) in missing
        }
        return self.devices != before

    def _all(
        self, found: Mapping[str, tuple[Device, ...]], fault_of: Callable[[str], str]
    ) -> Iterator[Device]:
        by_kind: dict[str, dict[str, Device]] = {}
        for devices in found.values():
            for device in devices:
                by_kind.setdefault(device.kind, {}).setdefault(device.unit, device)
        for kind, configured in self.configured.items():
            joined = (_joined(one, by_kind.get(kind)) for one in configured)
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


def _joined(device: Device, found: _Units | None) -> Device:
    """Return a device of the settings with what a probe of its kind tells about it."""
    if found is None:
        return device
    if device.unit not in found:
        return replace(device, missing=f"no probe finds it; found: {listed(found)}")
    other = found[device.unit]
    return replace(device, path=device.path or other.path, about=other.about, missing=other.missing)


def _checked(devices: Iterable[Device], fault_of: Callable[[str], str]) -> Iterator[Device]:
    """Yield the devices; one whose file is not there is missing."""
    for device in devices:
        fault = device.missing or (fault_of(device.path) if device.path else "")
        yield device if fault == device.missing else replace(device, missing=sanitized(fault))
