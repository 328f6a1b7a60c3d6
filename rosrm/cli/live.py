"""The live table: hosts with their usage against their limits, processes, queue, newest events.

A pure function of a `Snapshot`: `rosrm top` and `make demo` show it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rosrm.cli import formats, tables
from rosrm.core.views import HostRow, ProcessRow, ResourceRow, Snapshot

_BAR: Final = 14
_MOST_RESOURCES: Final = 3
#: Near its limit: from this part of it on.
_NEAR: Final = 0.9

#: Before all others where there is too little room.
_FIRST: Final = ("memory", "cpu", "gpu", "disk")
#: States in the order of interest; those that are over come last.
_ORDER: Final = (
    "stuck",
    "unreachable",
    "migrating",
    "stopping",
    "backoff",
    "starting",
    "assigned",
    "running",
    "checkpointed",
    "set_aside",
    "queued",
    "failed",
    "cancelled",
    "finished",
)
_OVER: Final = ("failed", "cancelled", "finished")


def render(snapshot: Snapshot, *, rows: int = 18, events: int = 4, note: str = "") -> Group:
    """What a snapshot shows.

    Args:
        snapshot: with hosts and processes; events are shown where it has any.
        rows: most processes shown.
        events: most events shown.
        note: goes beside the title.
    """
    return Group(*_parts(snapshot, rows, events, note))


def _parts(snapshot: Snapshot, rows: int, events: int, note: str) -> Iterator[RenderableType]:
    yield _title(snapshot, note)
    yield Text()
    yield _hosts(snapshot.hosts)
    yield Text()
    yield from _processes(snapshot.processes, rows)
    newest = list(snapshot.events)[-events:] if events else []
    if newest:
        yield Text()
        for event in newest:
            yield Text(tables.event_line(event), "dim", no_wrap=True, overflow="ellipsis")


def _title(snapshot: Snapshot, note: str) -> Text:
    counts = Counter(row.state for row in snapshot.processes)
    states = sorted(counts, key=_rank)
    text = Text(f"{snapshot.master}  {formats.duration(snapshot.uptime)}", "bold")
    for word in states:
        text.append("   ")
        text.append(f"{counts[word]} {formats.words(word)}", tables.STYLES.get(word, ""))
    if note:
        text.append(f"   {note}", "bold yellow")
    return text


def _hosts(hosts: Sequence[HostRow]) -> RenderableType:
    if not hosts:
        return Text("no host yet", "yellow")
    found = dict.fromkeys(resource.name for row in hosts for resource in row.resources)
    first = [name for name in _FIRST if name in found]
    names = [*first, *(name for name in found if name not in first)][:_MOST_RESOURCES]
    made = tables.table("HOST", "RUNS", *(name.upper() for name in names), right=("RUNS",))
    for row in hosts:
        by_name = {resource.name: resource for resource in row.resources}
        bars = [bar(by_name[name]) if name in by_name else Text("-") for name in names]
        made.add_row(_host(row), str(row.processes), *bars)
    return made


def _host(row: HostRow) -> Text:
    text = Text(row.description.name)
    if row.state != "up":
        text.append(" ").append_text(tables.state(row.state))
    if row.draining:
        text.append(" draining", "yellow")
    elif row.cordoned:
        text.append(" cordoned", "yellow")
    return text


def bar(resource: ResourceRow, width: int = _BAR) -> Text:
    """`████▒▒░░░│░░ 42%`: used, promised, and the limit as a stroke."""
    used, promised = _cells(resource.usage, width), _cells(resource.in_flight, width)
    limit = min(_cells(resource.limit, width), width - 1)
    style = _style(resource)
    text = Text(no_wrap=True)
    for cell in range(width):
        if cell == limit:
            text.append("│", "bold")
        elif cell < used:
            text.append("█", style)
        elif cell < used + promised:
            text.append("▒", style)
        else:
            text.append("░", "dim")
    return text.append(f" {formats.percent(resource.usage):>3}%", style)


def _cells(fraction: float, width: int) -> int:
    return round(min(max(fraction, 0.0), 1.0) * width) if math.isfinite(fraction) else 0


def _style(resource: ResourceRow) -> str:
    if resource.stale or not math.isfinite(resource.usage):
        return "dim"
    if resource.usage > resource.limit:
        return "red"
    return "yellow" if resource.usage > _NEAR * resource.limit else "green"


def _processes(processes: Sequence[ProcessRow], most: int) -> Iterator[RenderableType]:
    if not processes:
        yield Text("no process", "dim")
        return
    ordered = sorted(processes, key=lambda row: (_rank(row.state), _recency(row)))
    made = Table.grid(padding=(0, 2))
    for _ in range(6):
        made.add_column(no_wrap=True, overflow="ellipsis")
    for row in ordered[:most]:
        made.add_row(
            Text(row.name),
            tables.state(row.state),
            Text(row.host),
            formats.duration(row.since),
            formats.size(row.memory) if row.pid else "",
            Text(row.reason, "dim"),
        )
    yield made
    if len(ordered) > most:
        yield Text(f"and {len(ordered) - most} more", "dim")


def _rank(word: str) -> int:
    return _ORDER.index(word) if word in _ORDER else -1


def _recency(row: ProcessRow) -> float:
    """In the queue its order; of those that are over, the newest first."""
    if row.queue_position:
        return row.queue_position
    return row.since if row.state in _OVER else 0.0
