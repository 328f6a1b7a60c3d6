"""Time zone of this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from rosrm.model.schedules import is_zone

#: Link to the rules of the zone, and the file with its name where the rules are a copy.
_RULES: Final = Path("/etc/localtime")
_NAME: Final = Path("/etc/timezone")
_FOLDER: Final = "/zoneinfo/"


def local_zone() -> str:
    """Return the name of this machine's time zone; "UTC" if the zone has no name."""
    found = (os.environ.get("TZ", "").removeprefix(":"), *_of_system())
    return next((name for name in found if name and is_zone(name)), "UTC")


def _of_system() -> tuple[str, str]:
    linked = os.path.realpath(_RULES).partition(_FOLDER)[2]
    try:
        return linked, _NAME.read_text(encoding="utf-8").strip()
    except OSError:
        return linked, ""
