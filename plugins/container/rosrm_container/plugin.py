"""Registration of the launcher `podman`."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from importlib import import_module

from rosrm import Launcher, LauncherContext, LauncherOffer, SkipPlugin, hookimpl


@hookimpl
def register_launchers() -> Sequence[LauncherOffer]:
    """Offer `podman`, for processes with a `container`."""
    return [LauncherOffer("podman", _podman, "runs processes in containers of podman")]


def _podman(context: LauncherContext) -> Launcher:
    """Load the launcher, in slaves with podman only, because it imports psutil."""
    if shutil.which("podman") is None:
        raise SkipPlugin("podman is not installed")
    launcher: Launcher = import_module("rosrm_container.podman").Podman(context)
    return launcher
