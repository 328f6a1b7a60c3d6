"""Undoes what the ROS wheels' bootstrapper did to the environment, for processes that we start.

The wheels' `.pth` file executes Python anew with their library folders in LD_LIBRARY_PATH and with
a guard variable. A child that inherits both, and runs from another virtual environment, would load
the libraries of this one; without them its own bootstrapper does the right thing.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Final

_GUARD: Final = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_LIBRARIES: Final = "LD_LIBRARY_PATH"
#: PREFIX/lib/pythonX.Y/site-packages/ros_NAME.libs: a folder that the bootstrapper adds.
_WHEEL_FOLDER: Final = re.compile(
    r"(?P<prefix_lib>.*/lib)/python[0-9.]+/site-packages/ros_[^/]*\.libs"
)


def without_bootstrapper(
    environment: Mapping[str, str], prefix: str = sys.prefix
) -> dict[str, str]:
    """Undo what the ROS wheels' bootstrapper put there; without its guard nothing is touched.

    The bootstrapper keeps what LD_LIBRARY_PATH held before, though in no order: that stays.

    Args:
        environment: to be cleaned; it stays as it is.
        prefix: of this Python.
    """
    cleaned = dict(environment)
    if cleaned.pop(_GUARD, None) is None:
        return cleaned
    before = _without_wheel_folders(cleaned.pop(_LIBRARIES, "").split(":"), prefix)
    if before:
        cleaned[_LIBRARIES] = ":".join(before)
    return cleaned


def _without_wheel_folders(folders: list[str], prefix: str) -> list[str]:
    added = {"", f"{prefix}/lib"}
    for folder in folders:
        wheel = _WHEEL_FOLDER.fullmatch(folder)
        if wheel:
            added.update((folder, wheel["prefix_lib"]))
    return [folder for folder in folders if folder not in added]
