"""Output of `--json`: the rows of listings; a host and its description are one object."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

from rosrm.cli.output.plain import echo
from rosrm.model.codec import to_plain
from rosrm.model.rows import EventRow, HostRow, Listing, PluginRow, ProcessRow


def form(row: HostRow | ProcessRow | EventRow | PluginRow) -> dict[str, Any]:
    """Return a row as an object; the object of a host has the members of its description."""
    plain: dict[str, Any] = to_plain(row)
    return {**plain.pop("description", {}), **plain}


def forms(rows: Iterable[Any]) -> list[dict[str, Any]]:
    """Return the rows of a listing as objects."""
    return [form(row) for row in rows]


def status_form(snapshot: Listing) -> dict[str, Any]:
    """Return the overview of `rosrm status` as an object."""
    return {
        "master": snapshot.master,
        "uptime": snapshot.uptime,
        "last_sequence": snapshot.last_sequence,
        "trouble": snapshot.trouble,
        "security": snapshot.security,
        "strangers": snapshot.strangers,
        "hosts": Counter(row.state for row in snapshot.hosts),
        "processes": Counter(row.state for row in snapshot.processes),
        "failing_plugins": forms(snapshot.plugins),
    }


def show(value: Any) -> None:
    """Print one JSON value."""
    echo(json.dumps(finite(value), indent=2))


def show_line(value: Any) -> None:
    """Print one JSON value on one line."""
    echo(json.dumps(finite(value)))


def finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON lacks, by null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return value
