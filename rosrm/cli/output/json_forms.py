"""Output of `--json`: the views unchanged, except a host with its description in one object."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import typer

from rosrm.model.codec import to_plain
from rosrm.model.rows import EventRow, HostRow, Listing, PluginRow, ProcessRow


def host_form(row: HostRow) -> dict[str, Any]:
    """Return a host as one object: its description and its state."""
    plain = to_plain(row)
    made: dict[str, Any] = _finite({**plain.pop("description"), **plain})
    return made


def form(row: ProcessRow | EventRow | PluginRow) -> dict[str, Any]:
    """Return any other row as an object."""
    made: dict[str, Any] = _finite(to_plain(row))
    return made


def forms(rows: Sequence[Any]) -> list[dict[str, Any]]:
    """Return the rows of a listing as objects."""
    return [host_form(row) if isinstance(row, HostRow) else form(row) for row in rows]


def status_form(snapshot: Listing) -> dict[str, Any]:
    """Return the overview of `rosrm status` as an object."""
    return {
        "master": snapshot.master,
        "uptime": snapshot.uptime,
        "last_sequence": snapshot.last_sequence,
        "trouble": snapshot.trouble,
        "hosts": _counts(row.state for row in snapshot.hosts),
        "processes": _counts(row.state for row in snapshot.processes),
        "failing_plugins": [form(row) for row in snapshot.plugins],
    }


def show(value: Any) -> None:
    """Print one JSON value."""
    typer.echo(json.dumps(_finite(value), indent=2))


def show_line(value: Any) -> None:
    """Print one JSON value on a line of its own."""
    typer.echo(json.dumps(_finite(value)))


def _counts(states: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for state in states:
        counts[state] = counts.get(state, 0) + 1
    return counts


def _finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON lacks, by null for an unknown value."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value
