"""Free space on the file system of a file, as text for messages."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from rosrm.wording import size


def room_for(path: Path) -> str:
    """Return a sentence on the free and total size of a file's file system; "" if unreadable."""
    try:
        usage = shutil.disk_usage(path.parent)
        place = path.parent.resolve()
        while not os.path.ismount(place):
            place = place.parent
    except OSError:
        return ""
    free, total = size(usage.free, binary=True), size(usage.total, binary=True)
    return f"the file system {place} has {free} free of {total}"
