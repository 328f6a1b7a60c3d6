"""Free space on the file system of a file, as text for messages."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def room_for(path: Path) -> str:
    """Return the free and total size of a file's file system; "" where it cannot be read."""
    try:
        usage = shutil.disk_usage(path.parent)
        place = path.parent.resolve()
        while not os.path.ismount(place):
            place = place.parent
    except OSError:
        return ""
    return f"the file system {place} has {_size(usage.free)} free of {_size(usage.total)}"


def _size(count: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} TiB"
