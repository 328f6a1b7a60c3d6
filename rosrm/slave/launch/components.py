"""Devices, artifacts and ROS packages of this host, in the texts of a component."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rosrm.core.slave.state import HeldInstance
from rosrm.errors import LaunchError
from rosrm.model.devices import Device
from rosrm.model.values import Assignment, Component, ProcessSpec
from rosrm.slave.launch.artifacts import with_artifacts
from rosrm.slave.launch.devices import with_devices
from rosrm.slave.launch.packages import with_packages


def filled_component(
    component: Component, container: HeldInstance | None, *, devices: tuple[Device, ...],
    artifacts: Path, prefixes: Sequence[Path],
) -> Component:  # fmt: skip
    """Return a component with the values of its placeholders.

    A slave that re-adopted the container does not know its spec, so the facts of the memo decide.

    Args:
        container: instance into which the component is loaded; it holds devices and artifacts.
            None: it has ended since.
        devices: devices of this host.
        artifacts: directory of the artifacts of all processes.
        prefixes: prefixes of the ament index on this host.

    Raises:
        LaunchError: the container, a device or a ROS package is not there.
    """
    if container is None:
        raise LaunchError("its container has ended")
    instance = container.status.instance
    spec = ProcessSpec(instance.process, components=(component,), artifacts=container.artifacts)
    assignment = Assignment(instance, spec, epoch=0, node_name="", devices=container.devices)
    filled = with_artifacts(with_devices(assignment, devices), artifacts)
    return with_packages(filled.spec, prefixes).components[0]
