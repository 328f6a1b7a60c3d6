"""Reads of a probe, and the checks of its answers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any, Final

from rosrm.errors import PluginError
from rosrm.extensions.answers import exact_fields
from rosrm.extensions.contracts import Probe
from rosrm.extensions.plugin_calls import given, required
from rosrm.model.devices import Device, device_fault
from rosrm.model.values import (
    ABSURD_USAGE,
    EMPTY,
    Reading,
    ResourceDescription,
    is_plausible,
)

#: Maximum number of devices of a host, and of processes to which a probe attributes a resource.
MOST_DEVICES: Final = 256
MOST_PROCESSES: Final = 100_000
#: Resource name to pid to amount, in the base unit of the resource.
UsageByProcess = Mapping[str, Mapping[int, float]]


def read_values(probe: Probe, names: tuple[str, ...]) -> tuple[float, ...]:
    """Return one usage for each resource of a probe, in the order of `names`.

    Raises:
        PluginError: the answer is not one reading of each resource; the text says why.
    """
    values: dict[str, float] = {}
    answers: object = probe.read()
    if not isinstance(answers, Iterable):
        raise PluginError(f"answered {given(answers)}; a list of Readings is required")
    for answer in answers:
        reading = required(answer, Reading)
        if reading.resource not in names:
            raise PluginError(f"a reading of {reading.resource!r}, which it did not announce")
        if reading.resource in values:
            raise PluginError(f"two readings of {reading.resource!r}")
        usage = _fraction(reading)
        values[reading.resource] = usage
    if len(values) < len(names):
        missing = [name for name in names if name not in values]
        raise PluginError(f"no reading of {', '.join(missing)}")
    return tuple(map(values.__getitem__, names))


def _fraction(reading: Reading) -> float:
    """Return the usage of a reading; raise `PluginError` if it is not a valid fraction."""
    try:
        usage = float(reading.usage)
    except (TypeError, ValueError, OverflowError):
        usage = math.nan
    if not 0.0 <= usage <= ABSURD_USAGE:  # also where it is NaN
        raise PluginError(
            f"usage {reading.usage!r} of {reading.resource!r}; a fraction of its capacity is "
            f"required, 1.0 where it is full and at most {ABSURD_USAGE:g}"
        )
    return usage


def read_processes(probe: Probe, resources: Sequence[ResourceDescription]) -> UsageByProcess:
    """Return the usage of single processes; empty for a probe that does not measure it.

    Raises:
        PluginError: the answer is invalid, or lacks an attributed resource.
    """
    measure = getattr(probe, "by_process", None)
    if measure is None:
        return EMPTY
    answer = _mapping(measure())
    names = {resource.name for resource in resources}
    attributed = {one.name for one in resources if one.accounting == "attributed"}
    unknown, missing = answer.keys() - names, attributed - answer.keys()
    if unknown or missing:
        which = "announces no" if unknown else "lacks the attributed"
        raise PluginError(f"by_process() {which} {', '.join(map(str, unknown or missing))}")
    return {name: _amounts(name, _mapping(answer[name])) for name in names if name in answer}


def read_devices(probe: Probe) -> tuple[Device, ...]:
    """Return the devices that a probe finds; () for a probe that finds none.

    Raises:
        PluginError: the answer is invalid.
    """
    find = getattr(probe, "devices", None)
    if find is None:
        return ()
    answer: object = find()
    if not isinstance(answer, Iterable):
        raise PluginError(f"devices() answered {given(answer)}; a list of Devices is required")
    some = islice(answer, MOST_DEVICES + 1)
    devices = tuple(exact_fields(required(one, Device), Device) for one in some)
    if len(devices) > MOST_DEVICES:
        raise PluginError(f"devices() answered more than {MOST_DEVICES} devices")
    fault = device_fault(devices)
    if fault:
        raise PluginError(f"devices(): {fault}")
    return devices


def _mapping(answer: object) -> Mapping[Any, Any]:
    if not isinstance(answer, Mapping):
        raise PluginError(f"by_process() answered {given(answer)}; a mapping is required")
    return answer


def _amounts(resource: str, used: Mapping[int, float]) -> dict[int, float]:
    """Return checked amounts by pid; raise `PluginError` for an invalid one."""
    amounts: dict[int, float] = {}
    for pid, value in used.items():
        if len(amounts) >= MOST_PROCESSES:
            raise PluginError(f"by_process() has more than {MOST_PROCESSES} processes")
        try:
            process, amount = int(pid), float(value)
        except (TypeError, ValueError, OverflowError):
            process, amount = 0, math.nan
        if not is_plausible(resource, amount):
            raise PluginError(
                f"by_process() gives process {pid!r} {value!r} of {resource!r}; a number of at "
                "least 0 is required, in the unit of the resource"
            )
        amounts[process] = amount
    return amounts
