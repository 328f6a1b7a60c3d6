"""Live view: hosts with usage and limits, processes, queue, newest events.

The view is a pure function of a `Listing` and the width; `rosrm top` and `make demo` show it. In a
narrow terminal reasons are cut first, then bars shrink, then columns are hidden; names stay whole.
A reason is cut at the beginning that it shares with other reasons, and then at its end.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any, Final

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.text import Text

from rosrm.cli.output import tables
from rosrm.cli.output.legible import legible
from rosrm.model.rows import HostRow, Listing, ProcessRow, ResourceRow
from rosrm.wording import duration, percent, size, words

#: Highest number of processes in a view, if the height of the terminal is unknown.
ROWS: Final = 18
_BAR: Final = 14
_LEAST_BAR: Final = 4
#: Width of the percentage beside a bar: " 100%".
_NUMBER: Final = 5
_MOST_RESOURCES: Final = 3
#: Fraction of the limit from which a usage counts as near the limit.
_NEAR: Final = 0.9
_GAP: Final = 2
#: Smallest useful width of a reason; a column is hidden if the reason would be narrower.
_LEAST_REASON: Final = 20

#: Resources that are shown first, because a narrow terminal cuts the list.
_FIRST: Final = ("memory", "cpu", "gpu", "disk")
#: States in the order of the view: problems first, terminal states last.
_ORDER: Final = (
    "stuck",
    "unreachable",
    "unknown",
    "migrating",
    "stopping",
    "backoff",
    "starting",
    "assigned",
    "running",
    "checkpointed",
    "set_aside",
    "queued",
    "scheduled",
    "failed",
    "cancelled",
    "finished",
)
#: Beginnings of reasons that repeat the state.
_BEGINNINGS: Final = {"set_aside": "no host may take it: "}
_OVER: Final = ("failed", "cancelled", "finished")
#: Columns of the processes that are hidden in a narrow terminal, in this order.
_LEAVE: Final = ("MEMORY", "CPU", "SINCE", "HOST")
#: Columns of numbers.
_RIGHT: Final = ("SINCE", "CPU", "MEMORY")


@dataclass(frozen=True)
class TopView:
    """View of a listing, for a rich console of any width.

    Attributes:
        snapshot: listing with hosts and processes; its events are shown, if any.
        rows: highest number of processes.
        events: highest number of events.
        note: text beside the title.
        sort: order of the processes, a key of `SORTS`.
        foot: the last line.
    """

    snapshot: Listing
    rows: int = ROWS
    events: int = 4
    note: str = ""
    sort: str = "state"
    foot: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the parts from top to bottom."""
        width, snapshot = options.max_width, self.snapshot
        yield from _title(snapshot, self.note, width)
        yield Text()
        yield from _hosts(snapshot.hosts, width)
        yield Text()
        yield from _processes(snapshot.processes, self.rows, self.sort, width)
        newest = list(snapshot.events)[-self.events :] if self.events else []
        if newest:
            yield Text()
            for event in newest:
                yield Text(tables.event_line(event), "dim", no_wrap=True, overflow="ellipsis")
        if self.foot:
            yield Text(self.foot, "dim italic", no_wrap=True, overflow="ellipsis")


def _title(snapshot: Listing, note: str, width: int) -> Iterator[Text]:
    """Yield the title; if it wraps, a number and its state stay on one line."""
    counts = Counter(row.state for row in snapshot.processes)
    states = sorted(counts, key=_rank)
    parts = [Text(f"{counts[word]} {words(word)}", tables.STYLES.get(word, "")) for word in states]
    if note:
        parts.append(Text(note, "bold yellow"))
    line = Text(f"{snapshot.master}  {duration(snapshot.uptime)}", "bold")
    for part in parts:
        if line.cell_len + 3 + part.cell_len > width:
            yield line
            line = Text("  ").append_text(part)
        else:
            line.append("   ").append_text(part)
    yield line


# --- hosts ------------------------------------------------------------------------------------


def _hosts(hosts: Sequence[HostRow], width: int) -> Iterator[Text]:
    if not hosts:
        yield Text("no host yet", "yellow")
        return
    found = sorted({resource.name for row in hosts for resource in row.resources})
    first = [name for name in _FIRST if name in found]
    names = [*first, *(name for name in found if name not in first)][:_MOST_RESOURCES]
    cells = {"HOST": [_host(row) for row in hosts], "RUNS": [Text(str(r.processes)) for r in hosts]}
    free = width - _total(cells)
    while len(names) > 1 and free // len(names) < _GAP + _LEAST_BAR + _NUMBER:
        names.pop()
    room = free // max(1, len(names)) - _GAP - _NUMBER
    length = min(_BAR, max(_LEAST_BAR, room))
    by_host = [{resource.name: resource for resource in row.resources} for row in hosts]
    for name in names:
        cells[name.upper()] = [
            bar(by_name[name], length) if name in by_name else Text("-") for by_name in by_host
        ]
    yield from _lines(cells, width, ("RUNS",))


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
    """Return a bar of usage, reservations and limit, e.g. `████▒▒░░░│░░ 42%`."""
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
    return text.append(f" {percent(resource.usage):>3}%", style)


def _cells(fraction: float, width: int) -> int:
    return round(min(max(fraction, 0.0), 1.0) * width) if math.isfinite(fraction) else 0


def _style(resource: ResourceRow) -> str:
    if resource.stale or not math.isfinite(resource.usage):
        return "dim"
    if resource.usage > resource.limit:
        return "red"
    return "yellow" if resource.usage > _NEAR * resource.limit else "green"


# --- processes --------------------------------------------------------------------------------


def _rank(word: str) -> int:
    return _ORDER.index(word) if word in _ORDER else -1


def _recency(row: ProcessRow) -> float:
    """Return the sort key: queued processes in queue order, terminal ones newest first."""
    if row.queue_position:
        return row.queue_position
    return row.since if row.state in _OVER else 0.0


#: Orders of the processes, by name.
SORTS: Final[Mapping[str, Callable[[ProcessRow], Any]]] = {
    "state": lambda row: (_rank(row.state), _recency(row)),
    "cpu": lambda row: (row.pid == 0, -row.cpu),
    "memory": lambda row: (row.pid == 0, -row.memory),
    "name": lambda row: row.name,
}


def _processes(
    processes: Sequence[ProcessRow], most: int, sort: str, width: int
) -> Iterator[RenderableType]:
    if not processes:
        yield Text("no process", "dim")
        return
    first = sorted(processes, key=SORTS[sort])[:most]
    shown = [replace(row, reason=legible(row.reason)) for row in first]
    cells = {
        "NAME": [Text(row.name) for row in shown],
        "STATE": [tables.state(row.state) for row in shown],
        "HOST": [Text(row.host) for row in shown],
        "SINCE": [Text(duration(row.since)) for row in shown],
        "CPU": [tables.age(row, f"{row.cpu:.2f}" if row.pid else "") for row in shown],
        "MEMORY": [tables.age(row, size(row.memory) if row.pid else "") for row in shown],
    }
    longest = max(cell_len(_why(row)) for row in shown)
    for column in _LEAVE:
        wanted = min(_LEAST_REASON, longest) if any(cells[column]) else longest
        if width - _total(cells) - _GAP < wanted:
            del cells[column]
    room = max(0, width - _total(cells) - _GAP)
    reasons = [Text(why, "dim") for why in _reasons(shown, room)]
    yield from _lines({**cells, "WHY": reasons}, width, _RIGHT)
    if len(processes) > len(shown):
        yield Text(f"and {len(processes) - len(shown)} more", "dim")


def _why(row: ProcessRow) -> str:
    return " ".join(tables.why(row).split())


def _reasons(rows: Sequence[ProcessRow], room: int) -> list[str]:
    """Return the reason of each process's state, too long ones without their common beginning."""
    known = {row.reason for row in rows if cell_len(_why(row)) > room}
    return [
        _why(replace(row, reason=_without_beginning(row, known, room)))
        if row.reason in known
        else _why(row)
        for row in rows
    ]


def _without_beginning(row: ProcessRow, reasons: set[str], room: int) -> str:
    """Return a reason from the word at which it differs from the other reasons."""
    shared = max((_alike(row.reason, other) for other in reasons - {row.reason}), default=0)
    beginning = _BEGINNINGS.get(row.state, "")
    begin = len(beginning) if beginning and row.reason.startswith(beginning) else 0
    if shared > max(begin, room // 2):
        enough = max(0, len(row.reason) - room)  # the rest from here fits
        begin = max(begin, row.reason.find(" ", min(shared - 1, enough)) + 1)
    return f"…{row.reason[begin:]}" if begin else row.reason


def _alike(one: str, other: str) -> int:
    """Return the length of the common leading words of two texts."""
    letters = takewhile(bool, map(str.__eq__, one, other))
    return one.rfind(" ", 0, len(list(letters))) + 1


# --- columns ----------------------------------------------------------------------------------


def _width(head: str, cells: Sequence[Text]) -> int:
    return max(cell_len(head), *(cell.cell_len for cell in cells))


def _total(columns: Mapping[str, Sequence[Text]]) -> int:
    """Return the width of columns with the gaps between them."""
    return sum(_width(*column) + _GAP for column in columns.items()) - _GAP


def _lines(
    columns: Mapping[str, Sequence[Text]], width: int, right: Sequence[str]
) -> Iterator[Text]:
    """Return lines with columns below their heads; cut too long cells at the right."""
    widths = {head: _width(head, cells) for head, cells in columns.items()}
    heads = {head: Text(head, "bold") for head in columns}
    count = len(next(iter(columns.values())))
    rows = [heads, *({head: cells[at] for head, cells in columns.items()} for at in range(count))]
    for row in rows:
        line = Text(no_wrap=True)
        for head, cell in row.items():
            pad = " " * (widths[head] - cell.cell_len)
            line.append(" " * _GAP if line else "")
            line.append_text(Text(pad).append_text(cell) if head in right else cell.copy())
            line.append("" if head in right else pad)
        line.rstrip()
        line.truncate(width, overflow="ellipsis")
        yield line
