"""Picture of processes over hosts, from a timeline and a listing. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosrm.model.rows import Listing, ProcessRow
from rosrm.timeline.lanes import lanes
from rosrm.timeline.reading import Timeline
from rosrm.timeline.values import Failure, HostSpan, Move, Placement
from rosrm.wording import counted, first_line, sanitized, words
from rosrm_web.page.rows import Row

#: Bars of a picture; of more, the longest are drawn.
MOST_BARS: Final = 2500
#: Arrows, crosses and times of hosts; of more, the newest are drawn.
MOST_MARKS: Final = 500
#: Rows of the table.
MOST_ROWS: Final = 200
#: Styles of bars, in the order of their colours.
STYLES: Final = ("running", "starting", "moving", "in trouble", "failed", "ended")
#: States of processes that hold a host, with the styles of their bars.
_STATES: Final = {
    "assigned": 1, "starting": 1, "running": 0, "migrating": 2, "backoff": 3, "stopping": 3,
    "unreachable": 3, "stuck": 3, "unknown": 3,
}  # fmt: skip
_FAILED, _ENDED = STYLES.index("failed"), STYLES.index("ended")

#: Numbers and texts of one shape: x, three more numbers, the process, and the text of the shape.
Shape = tuple[float, float, float, float, str, str]
_Placed = tuple[int, Placement]


@dataclass(frozen=True, slots=True)
class View:
    """Part of the timeline that a user looks at.

    Attributes:
        seconds: length.
        end: unix time, which stays the same when old events are forgotten; None: now.
        host, application, process: parts of the names that are shown; "": all.
    """

    seconds: float
    end: float | None = None
    host: str = ""
    application: str = ""
    process: str = ""


@dataclass(slots=True)
class Picture:
    """Shapes of a picture. A time is unix time in ms; an end 0 is the right edge.

    Attributes:
        rows: all rows; each lane begins with a row for the name of its host.
        lanes: 0, first row, number of rows, 0 or 1 in turn, "", text.
        bars: begin, end, row, style, process, text.
        moves: time, row of the source, row of the destination, 0, process, text.
        failures: time, row, 0, 0, process, text.
        spans: begin, end, first row, number of rows (0: a line above the first row), "", text.
        table: moves, failures and times of hosts by their ids, as text.
        summary: one sentence.
    """

    rows: int = 0
    lanes: list[Shape] = field(default_factory=list)
    bars: list[Shape] = field(default_factory=list)
    moves: list[Shape] = field(default_factory=list)
    failures: list[Shape] = field(default_factory=list)
    spans: list[Shape] = field(default_factory=list)
    table: dict[str, Row] = field(default_factory=dict)
    summary: str = ""


def picture(timeline: Timeline, listing: Listing, view: View, now: float) -> Picture:
    """Return the picture of a part of a timeline.

    Args:
        listing: present states of the hosts and processes.
        now: seconds of the timeline.
    """
    return _Drawing(timeline, listing, view, now).whole()


class _Drawing:
    def __init__(self, timeline: Timeline, listing: Listing, view: View, now: float) -> None:
        self._timeline, self._listing, self._view, self._now = timeline, listing, view, now
        self._end = now if view.end is None else timeline.clock.seconds(view.end)
        self._begin = self._end - view.seconds
        self._processes = {row.name: row for row in listing.processes}
        self._found = timeline.processes.histories(math.inf)
        self._made = Picture()
        self._bands: dict[str, tuple[int, int]] = {}
        self._rows: dict[tuple[str, str], list[tuple[float, int]]] = {}

    def whole(self) -> Picture:
        made = self._made
        shown, omitted = self._placements()
        self._draw_lanes(shown)
        moves = [
            one
            for one in self._found.moves
            if self._has(one.time, one.process, one.source, one.destination) and not one.within
        ]
        failures = [
            one for one in self._timeline.failures if self._has(one.time, one.process, one.host)
        ]
        gone, over = self._spans()
        made.moves = [
            self._move(one)
            for one in moves[-MOST_MARKS:]
            if one.done and {one.source, one.destination} <= self._bands.keys()
        ]
        made.failures = [
            self._failure(one) for one in failures[-MOST_MARKS:] if one.host in self._bands
        ]
        made.spans = list(map(self._span, [*gone[-MOST_MARKS:], *over[-MOST_MARKS:]]))
        made.table = self._table(moves, failures, [*gone, *over])
        parts = [
            counted(len(self._bands), "host"),
            counted(len({one.process for _, one in shown}), "process", "processes"),
            counted(sum(one.done for one in moves), "move"),
            counted(len(failures), "failure"),
            *([f"{counted(omitted, 'short run')} not drawn"] if omitted else []),
        ]
        made.summary = ", ".join(parts)
        return made

    # --- what is shown -------------------------------------------------------------------

    def _placements(self) -> tuple[Sequence[_Placed], int]:
        """Return the placements in the view with their rows, and how many were left out.

        All placements count for the rows, so that a bar keeps its row when others leave the view.
        """
        named = [
            one for one in [*self._found.placements, *self._unknown_begins()]
            if self._is_named(one.process) and self._view.host in one.host
        ]  # fmt: skip
        inside = [
            (row, one)
            for placed in lanes(named).values()
            for row, one in placed
            if one.end > self._begin and one.begin < self._end
        ]
        if len(inside) > MOST_BARS:
            inside.sort(key=lambda one: max(one[1].begin, self._begin) - min(one[1].end, self._end))
        return inside[:MOST_BARS], max(0, len(inside) - MOST_BARS)

    def _unknown_begins(self) -> Iterable[Placement]:
        """Yield the placements that began before the first known event, at second 0."""
        known = {one.process for one in self._found.placements if one.end == math.inf}
        for row in self._listing.processes:
            if row.state in _STATES and row.host and row.name not in known:
                begin = min(0.0, self._now - row.since)
                yield Placement(row.name, row.host, begin, math.inf, row.number)

    def _is_named(self, process: str) -> bool:
        view = self._view
        row = self._processes.get(process)
        application = row.application if row is not None else ""
        return view.process in process and view.application in application

    def _has(self, time: float, process: str, *hosts: str) -> bool:
        """Return True for a time in the view, a shown process and a shown host, or none at all."""
        is_now = self._begin <= time < self._end and self._is_named(process)
        return is_now and any(not host or host in self._bands for host in hosts)

    def _spans(self) -> tuple[list[HostSpan], list[HostSpan]]:
        times = self._timeline.hosts
        gone, over = (
            [
                one for one in spans
                if one.end > self._begin and one.begin < self._end and one.host in self._bands
            ]
            for spans in (times.gone(math.inf), times.over_limit(math.inf))
        )  # fmt: skip
        return gone, over

    # --- shapes --------------------------------------------------------------------------

    def _draw_lanes(self, shown: Sequence[_Placed]) -> None:
        bars: dict[str, list[_Placed]] = {}
        for row, one in shown:
            bars.setdefault(one.host, []).append((row, one))
        known = {row.description.name: row.state for row in self._listing.hosts}
        view, made = self._view, self._made
        for host in sorted(bars.keys() | known.keys()):
            placed = bars.get(host, [])
            if view.host not in host or (not placed and (view.process or view.application)):
                continue
            used = {row: at for at, row in enumerate(sorted({row for row, _ in placed}), 1)}
            top, count = made.rows, 1 + max(len(used), 1)
            state = known.get(host, "up")
            text = host if state == "up" else f"{host} ({state})"
            made.lanes.append((0, top, count, len(made.lanes) % 2, "", text))
            self._bands[host] = (top, count)
            for row, one in placed:
                self._draw_bar(one, top + used[row])
            made.rows += count

    def _draw_bar(self, one: Placement, row: int) -> None:
        self._rows.setdefault((one.process, one.host), []).append((one.begin, row))
        if one.end == math.inf:
            style, text = self._present(self._processes.get(one.process))
        else:
            style = _FAILED if one.ended_by == "failed" else _ENDED
            text = words(one.ended_by)
        self._made.bars.append(
            (self._ms(one.begin), self._ms(one.end), row, style, one.process,
             f"on {one.host}: {text}")
        )  # fmt: skip

    @staticmethod
    def _present(row: ProcessRow | None) -> tuple[int, str]:
        if row is None:
            return _ENDED, "removed"
        return _STATES.get(row.state, _ENDED), words(row.state)

    def _move(self, one: Move) -> Shape:
        source, destination = (
            self._row(one.process, host, one.time) for host in (one.source, one.destination)
        )
        cause = sanitized(first_line(one.cause))
        text = f"{one.source} to {one.destination}, {one.how}: {cause}"
        return (self._ms(one.time), source, destination, 0, one.process, text)

    def _failure(self, one: Failure) -> Shape:
        row = self._row(one.process, one.host, one.time)
        return (self._ms(one.time), row, 0, 0, one.process, sanitized(first_line(one.message)))

    def _row(self, process: str, host: str, time: float) -> int:
        """Return the row of the newest bar of a process on a host that began by a time."""
        begun = [one for one in self._rows.get((process, host), ()) if one[0] <= time]
        return max(begun)[1] if begun else self._bands[host][0]

    def _span(self, one: HostSpan) -> Shape:
        top, count = self._bands[one.host]
        place = (top, count) if one.is_gone else (top + count, 0)
        return (self._ms(one.begin), self._ms(one.end), *place, "", one.phrase)

    def _ms(self, seconds: float) -> int:
        if seconds == math.inf:
            return 0
        return round(1e3 * self._timeline.clock.wall_time(seconds))

    # --- the same as text ----------------------------------------------------------------

    def _table(
        self, moves: Iterable[Move], failures: Iterable[Failure], spans: Iterable[HostSpan]
    ) -> dict[str, Row]:
        found: list[tuple[float, str, str, str, str]] = [
            (one.time, "moved" if one.done else "stayed", one.process,
             f"{one.source} to {one.destination}", f"{one.how}: {one.cause}")
            for one in moves
        ]  # fmt: skip
        found += [
            (one.begin, one.what if one.is_gone else "over limit", "", one.host, one.phrase)
            for one in spans
        ]
        found += [
            (one.time, "restarts" if one.restarts else "failed", one.process, one.host, one.message)
            for one in failures
        ]
        found.sort()
        return dict(map(self._text, found[-MOST_ROWS:]))

    def _text(self, found: tuple[float, str, str, str, str]) -> tuple[str, Mapping[str, Any]]:
        time, what, process, host, message = found
        key = f"{what} {time:.3f} {process or host}"
        return key, {
            "id": key, "time": self._ms(time) / 1e3, "what": what, "process": process,
            "host": host, "message": sanitized(first_line(message)),
        }  # fmt: skip
