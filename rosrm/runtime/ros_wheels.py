"""Removal of the changes that the ROS wheels' bootstrapper made to the environment of children.

The wheels' `.pth` file executes Python a second time, with their library folders in LD_LIBRARY_PATH
and with a guard variable. A child that inherits both, and runs from another virtual environment,
would load the libraries of this one. Without them the child's own bootstrapper sets up its own.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Final

_GUARD: Final = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_LIBRARIES: Final = "LD_LIBRARY_PATH"
#: PREFIX/lib/pythonX.Y/site-packages/ros_NAME.libs: a folder added by the bootstrapper.
_WHEEL_FOLDER: Final = re.compile(
    r"(?P<prefix_lib>.*/lib)/python[0-9.]+/site-packages/ros_[^/]*\.libs"
)


def without_bootstrapper(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the bootstrapper's changes; without its guard, unchanged.

    Folders that were in LD_LIBRARY_PATH before the bootstrapper stay, in any order.
    """
    cleaned = dict(environment)
    if cleaned.pop(_GUARD, None) is None:
        return cleaned
    before = _without_wheel_folders(cleaned.pop(_LIBRARIES, "").split(":"))
    if before:
        cleaned[_LIBRARIES] = ":".join(before)
    return cleaned


def _without_wheel_folders(folders: list[str]) -> list[str]:
    added = {"", f"{sys.prefix}/lib"}
    for folder in folders:
        wheel = _WHEEL_FOLDER.fullmatch(folder)
        if wheel:
            added.update((folder, wheel["prefix_lib"]))
    return [folder for folder in folders if folder not in added]
