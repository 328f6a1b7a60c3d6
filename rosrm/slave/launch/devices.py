"""Devices of an assignment, in its arguments and parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rosrm.errors import LaunchError
from rosrm.model.devices import Device, device_values, filled, title_of
from rosrm.model.values import Assignment


def with_devices(assignment: Assignment, devices: tuple[Device, ...]) -> Assignment:
    """Return an assignment with the values of its devices in place of `{device.KIND}`.

    Args:
        devices: devices of this host.

    Raises:
        LaunchError: the assignment lacks a device, or has one that this host does not have.
    """
    spec, there = assignment.spec, {(one.kind, one.unit) for one in devices}
    for held in assignment.devices:
        if (held.kind, held.unit) not in there:
            title = title_of(held.kind, held.unit)
            raise LaunchError(f"{assignment.instance}: {title} is no device of this host now")
    values = device_values(assignment.devices, devices)
    lacking = [need.kind for need in spec.devices if need.kind not in values]
    if lacking:
        raise LaunchError(f"{assignment.instance}: it was assigned without a {lacking[0]}")
    if not values:
        return assignment
    arguments = tuple(filled(argument, values) for argument in spec.arguments)
    parameters = {name: _filled(value, values) for name, value in spec.parameters.items()}
    return replace(assignment, spec=replace(spec, arguments=arguments, parameters=parameters))


def _filled(value: Any, values: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        return filled(value, values)
    return [_filled(one, values) for one in value] if isinstance(value, list) else value
