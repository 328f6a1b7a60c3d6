"""Devices of an assignment, in the texts of its spec."""

from __future__ import annotations

from rosrm.errors import LaunchError
from rosrm.model.devices import Device, device_values, title_of
from rosrm.model.placeholders import DEVICE
from rosrm.model.values import Assignment
from rosrm.slave.launch.placeholders import filled


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
    return filled(assignment, {f"{DEVICE}{kind}": value for kind, value in values.items()})
