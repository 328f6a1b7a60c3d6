"""Rows of a picture of processes over hosts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rosrm.timeline.values import Placement


def lanes(placements: Iterable[Placement]) -> Mapping[str, list[tuple[int, Placement]]]:
    """Return for each host its placements with their rows, in which they do not overlap."""
    ends: dict[str, list[float]] = {}
    rows: dict[str, list[tuple[int, Placement]]] = {}
    for one in sorted(placements, key=lambda one: one.begin):
        taken = ends.setdefault(one.host, [])
        row = next((at for at, end in enumerate(taken) if end <= one.begin), len(taken))
        taken[row : row + 1] = [one.end]
        rows.setdefault(one.host, []).append((row, one))
    return rows
