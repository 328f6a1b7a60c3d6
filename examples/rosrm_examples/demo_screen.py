"""Output of a running demo: a live table in a terminal, else a line every few seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, Protocol, TypeAlias

from rich.console import Console
from rich.live import Live

from rosrm import EventRow, Listing, ProcessRow
from rosrm.cli.output.top import TopView
from rosrm_examples.demo_job import count_by_kind
from rosrm_examples.demo_record import RUNNING, sample_of

_EVENTS: Final = 5
#: Lines of the table beside those of the processes: title, hosts, events, and gaps.
_OTHER_LINES: Final = 13 + _EVENTS
_FEWEST_ROWS: Final = 4
_LINE_EVERY_S: Final = 3.0


class Screen(Protocol):
    """A display of the progress of a demo."""

    def show(self, view: Listing, elapsed: float) -> None:
        """Show a view, `elapsed` seconds after the beginning."""

    def say(self, text: str) -> None:
        """Print a line that stays."""

    def close(self) -> None:
        """Leave the terminal as it was."""


#: Text for a view, in one line.
Words: TypeAlias = Callable[[Listing], str]


def screen_for(console: Console, note: Words | None = None, line: Words | None = None) -> Screen:
    """Return the live table where the terminal can show it, else lines.

    Args:
        note: text beside the table; the default is that of the demo of pieces and holders.
        line: text in place of the table.
    """
    if console.is_terminal:
        return LiveScreen(console, note or note_of)
    return LineScreen(console, line or line_of)


class LiveScreen:
    """The table of `rosrm top`, renewed in place."""

    def __init__(self, console: Console, note: Words) -> None:
        self._console = console
        self._note = note
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._events: deque[EventRow] = deque(maxlen=_EVENTS)

    def show(self, view: Listing, elapsed: float) -> None:  # noqa: ARG002 - the table has a clock
        """Update the table."""
        self._events.extend(view.events)
        rows = max(_FEWEST_ROWS, self._console.height - _OTHER_LINES)
        shown = replace(view, events=list(self._events))
        table = TopView(shown, rows=rows, events=_EVENTS, note=self._note(view))
        self._live.start()
        self._live.update(table, refresh=True)

    def say(self, text: str) -> None:
        """Print a line above the table."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Remove the table."""
        self._live.stop()


class LineScreen:
    """A line every few seconds, and one for each migration."""

    def __init__(self, console: Console, line: Words) -> None:
        self._console = console
        self._line = line
        self._next = 0.0

    def show(self, view: Listing, elapsed: float) -> None:
        """Print new migrations, and the line when it is due."""
        for event in view.events:
            if event.kind in ("migration_begun", "over_limit"):
                self.say(f"        {event.message}")
        if elapsed >= self._next:
            self._next = elapsed + _LINE_EVERY_S
            self.say(f"{elapsed:5.0f} s  {self._line(view)}")

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Do nothing: printed lines stay."""


def note_of(view: Listing) -> str:
    """Return the phase of the demo, in a few words."""
    runs = count_by_kind([row.name for row in view.processes if row.state in RUNNING])
    if runs["piece"]:
        return "the pieces are mapped"
    if any(row.state == "queued" for row in view.processes):
        return "the hosts are full: the queue waits"
    if runs["recorder"]:
        return "the recorder grows"
    return ""


def line_of(view: Listing) -> str:
    """Return the line `memory 41 40 42 %   9 pieces and 8 holders run, 3 wait, 12 finished`."""
    waiting = sum(row.state == "queued" for row in view.processes)
    finished = sum(row.state == "finished" for row in view.processes)
    return f"{memory_line(view)}   {_run(view.processes)}, {waiting} wait, {finished} finished"


def memory_line(view: Listing) -> str:
    """Return `memory 41 40 42 %`, in the order of the hosts."""
    memory = sample_of(view).usage.get("memory", {})
    used = " ".join("  ?" if value is None else f"{100 * value:3.0f}" for value in memory.values())
    return f"memory {used} %"


def _run(rows: Sequence[ProcessRow]) -> str:
    counts = count_by_kind([row.name for row in rows if row.state in RUNNING])
    parts = [f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n]
    if not parts:
        return "nothing runs"
    return f"{' and '.join(parts)} run{'s' if sum(counts.values()) == 1 else ''}"
