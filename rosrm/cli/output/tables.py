"""Listings as tables that fit in 80 columns."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Span, Text

from rosrm.cli.output.legible import legible, offsets
from rosrm.model.rows import DeviceRow, EventRow, HostRow, PluginRow, ProcessRow, ResourceRow
from rosrm.wording import (
    amount,
    counted,
    duration,
    ending_of,
    listed,
    percent,
    size,
    standing,
    words,
)

#: Width of tables in a file or pipe, large enough that no line is cut or wrapped.
_PIPE_WIDTH: Final = 100_000

#: Style of each state; other states are plain.
STYLES: Final = {
    "running": "green",
    "finished": "green",
    "up": "green",
    "selected": "green",
    "queued": "yellow",
    "set_aside": "yellow",
    "scheduled": "cyan",
    "backoff": "yellow",
    "migrating": "cyan",
    "checkpointed": "cyan",
    "suspect": "yellow",
    "expected": "yellow",
    "detached": "yellow",
    "absent": "yellow",
    "failed": "red",
    "stuck": "bold red",
    "unreachable": "red",
    "unknown": "yellow",
    "lost": "red",
    "broken": "red",
    "failing": "red",
}


class PrintableConsole(Console):
    """Console that shows the characters of texts that a terminal cannot show as numbers."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield the parts of a renderable; control sequences of rich itself stay."""
        for segment in super().render(renderable, options):
            text = segment.text
            yield segment if segment.control else segment._replace(text=legible(text, self.file))


class _Table(Table):
    """Table whose cells are legible before their widths are measured."""

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """Add a row of texts."""
        super().add_row(*map(_legible_cell, cells), **options)


def _legible_cell(cell: RenderableType | None) -> RenderableType | None:
    """Return a cell whose text is legible, in its colours."""
    text = cell.plain if isinstance(cell, Text) else cell
    if not isinstance(text, str) or (shown := legible(text)) == text:
        return cell
    if not isinstance(cell, Text):
        return shown
    at = offsets(text)
    spans = [Span(at[start], at[end], style) for start, end, style in cell.spans]
    return Text(shown, cell.style, spans=spans)


def console() -> Console:
    """Return the console for tables, as wide as the terminal or COLUMNS; else without a limit."""
    output = PrintableConsole(highlight=False)
    if output.is_terminal or os.environ.get("COLUMNS", "").strip("0").isdigit():
        return output
    return PrintableConsole(highlight=False, width=_PIPE_WIDTH)


def table(*columns: str, right: Sequence[str] = ()) -> Table:
    """Return an empty table; the columns in `right` have numbers, aligned at the right."""
    made = _Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold", show_edge=False)
    for column in columns:
        number = column in right
        made.add_column(
            column, justify="right" if number else "left", no_wrap=number, overflow="fold"
        )
    return made


def show(renderable: RenderableType) -> None:
    """Print a table; into a file or pipe without trailing blanks."""
    output = console()
    if output.is_terminal:
        output.print(renderable)
        return
    with output.capture() as captured:
        output.print(renderable)
    output.file.write("".join(f"{line.rstrip()}\n" for line in captured.get().splitlines()))
    output.file.flush()  # in this call click turns a broken pipe into exit code 1


def state(word: str) -> Text:
    """Return a state in its colour."""
    return Text(words(word), style=STYLES.get(word, ""))


def sentence(name: str, word: str) -> Text:
    """Return the beginning of a sentence: a process and its coloured state."""
    verb, _, rest = standing(word).partition(" ")
    return Text(f"{name} {verb} ").append(rest, STYLES.get(word, ""))


def processes(rows: Sequence[ProcessRow]) -> Table:
    """Return the table of `rosrm ps`, with a column of limits if any limit holds."""
    numbers = ("SINCE", "CPU", "MEMORY")
    limited = any(map(limits, rows))
    made = table(
        "NAME", "STATE", "HOST", *numbers, *(["LIMITS"] if limited else []), "WHY", right=numbers
    )
    for row in rows:
        runs = row.pid != 0
        made.add_row(
            Text(row.name),
            state(row.state),
            Text(row.host),
            duration(row.since),
            age(row, f"{row.cpu:.2f}") if runs else "",
            age(row, size(row.memory)) if runs else "",
            *([limits(row)] if limited else []),
            Text(why(row)),
        )
    return made


def limits(row: ProcessRow) -> str:
    """Return the limits that hold for a process, e.g. `1.5 cores, 500 MB`."""
    held = [amount(row.cpu_limit, "core")] if row.cpu_limit else []
    return ", ".join([*held, *([size(row.memory_limit)] if row.memory_limit else [])])


def age(row: ProcessRow, reading: str) -> Text:
    """Return a reading of a process; a stale reading begins with `?`."""
    return Text(f"?{reading}", "dim") if row.stale and reading else Text(reading)


def why(row: ProcessRow) -> str:
    """Return one line with the reason for a process's state and its history."""
    parts = [f"no. {row.queue_position} in the queue"] if row.queue_position else []
    if row.reason:
        parts.append(row.reason)
    elif row.state == "failed" and row.exit_code is not None:
        parts.append(ending_of(row.exit_code))
    if row.restarts and "restart" not in row.reason:
        parts.append(counted(row.restarts, "restart"))
    if row.migrations:
        parts.append(f"moved {row.migrations}x")
    return "; ".join(parts)


def hosts(rows: Sequence[HostRow]) -> Table:
    """Return the table of `rosrm hosts`: usage and limit, in percent of the capacity."""
    # By name: a probe that is late registers last, which must not move the columns.
    resources = sorted({resource.name for row in rows for resource in row.resources})
    numbers = ("RUNS", *(f"{name} %" for name in resources))
    free = ("FREE DEVICES",) if any(row.devices for row in rows) else ()
    made = table("HOST", "STATE", *numbers, *free, right=numbers)
    for row in rows:
        by_name = {resource.name: resource for resource in row.resources}
        cells = [usage(by_name[name]) if name in by_name else Text("-") for name in resources]
        cells += [Text(free_devices(row.devices)) for _ in free]
        made.add_row(Text(row.description.name), host_state(row), str(row.processes), *cells)
    return made


def free_devices(devices: Iterable[DeviceRow]) -> str:
    """Return how many units of each kind are free, e.g. `camera 0/1 (front missing), gpu 1.5/2`."""
    kinds: dict[str, list[DeviceRow]] = {}
    for one in devices:
        kinds.setdefault(one.kind, []).append(one)
    parts = []
    for kind, units in kinds.items():
        missing = [one.unit for one in units if one.missing]
        note = f" ({listed(missing)} missing)" if missing else ""
        parts.append(f"{kind} {sum(one.free for one in units):.3g}/{len(units)}{note}")
    return ", ".join(parts)


def host_state(row: HostRow) -> Text:
    """Return the state of a host and the operator's requests (cordon, drain)."""
    text = state(row.state)
    if row.draining:
        text.append(", drained" if row.drained else ", draining", "yellow")
    elif row.cordoned:
        text.append(", cordoned", "yellow")
    return text


def usage(resource: ResourceRow) -> Text:
    """Return usage and limit in percent, e.g. `34/80`."""
    text = f"{percent(resource.usage)}/{percent(resource.limit)}"
    if resource.stale:
        return Text(f"?{text}", "dim")
    return Text(text, "red" if resource.usage > resource.limit else "")


def plugins(rows: Iterable[PluginRow]) -> Table:
    """Return the table of `rosrm plugins`."""
    made = table("KIND", "NAME", "STATE", "HOST", "FROM", "ABOUT")
    for row in rows:
        cells = (row.kind, row.name, row.host, row.distribution, row.reason)
        kind, name, host, distribution, reason = map(Text, cells)
        made.add_row(kind, name, state(row.state), host, distribution, reason)
    return made


def clock(wall_time: float) -> str:
    """Return a time of day in the local time zone."""
    return time.strftime("%H:%M:%S", time.localtime(wall_time))


def event_line(row: EventRow) -> str:
    """Return one line of the event record."""
    beginning = f"{clock(row.wall_time)}  {words(row.kind):<18} "
    return beginning + row.message.replace("\n", f"\n{'':{len(beginning)}}")


def event(row: EventRow) -> Table:
    """Return one event for a terminal; a long message wraps with a hanging indent."""
    return entry(clock(row.wall_time), row.kind, row.message)


def entry(when: str, kind: str, message: str) -> Table:
    """Return time, kind and message of an event; a long message wraps with a hanging indent."""
    made = _Table.grid(padding=(0, 1, 0, 0), pad_edge=False)
    made.add_row(Text(f"{when} "), Text(f"{words(kind):<18}"), Text(message))
    return made
