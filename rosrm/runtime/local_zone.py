"""Time zone of this machine, by the rules of the C library, so that schedules agree with `date`."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final
from zoneinfo import TZPATH, available_timezones

from rosrm.model.schedules import is_zone

#: Rules of the zone: a link into the database of zones, or a copy of a file there.
_RULES: Final = Path("/etc/localtime")
#: Name of the zone, which the C library does not read: it only chooses between equal rules.
_NAME: Final = Path("/etc/timezone")
_FOLDER: Final = "/zoneinfo/"
#: Table of the names that a database prefers among those with equal rules.
_USUAL: Final = "zone1970.tab"


def local_zone() -> str:
    """Return this machine's time zone: its name, or its rules as in TZ; "UTC" for a bad TZ."""
    variable = os.environ.get("TZ")
    if variable is None:
        return _zone_of_file(_RULES) or "UTC"
    text = variable.removeprefix(":")
    if text.startswith("/"):
        return _zone_of_file(Path(text)) or "UTC"
    return text if is_zone(text) else "UTC"


def _zone_of_file(path: Path) -> str:
    """Return the zone whose rules are in a file; "": none."""
    linked = os.path.realpath(path).partition(_FOLDER)[2]
    if linked and is_zone(linked):
        return linked
    rules = _content(path)
    stated = _content(_NAME).decode(errors="replace").strip()
    equal = [name for name in sorted(available_timezones()) if rules and _rules_of(name) == rules]
    if equal:
        usual = b"".join(_content(Path(one, _USUAL)) for one in TZPATH).decode(errors="replace")
        preferred = [name for name in equal if f"\t{name}" in usual]
        return stated if stated in equal else [*preferred, *equal][0]
    footer = rules.rstrip(b"\n").rpartition(b"\n")[2].decode(errors="replace")
    return next((one for one in (footer, stated) if one and is_zone(one)), "")


def _rules_of(name: str) -> bytes:
    return next((found for one in TZPATH if (found := _content(Path(one, name)))), b"")


def _content(path: Path) -> bytes:
    with contextlib.suppress(OSError):
        return path.read_bytes()
    return b""
