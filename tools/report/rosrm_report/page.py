"""A report as one HTML file, without a script and without any reference to another file. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from statistics import median
from typing import Any, Final

import jinja2

from rosrm.timeline.values import Move
from rosrm.version import __version__
from rosrm.wording import counted, duration, sanitized
from rosrm_report import svg
from rosrm_report.model import Report

#: Rows of a table; the rest is only in the JSON.
MOST_ROWS: Final = 200
#: Rows of the table of placements.
_MOST_PLACEMENTS: Final = 500
_MOST_TEXT: Final = 600


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a page; `omitted` rows are left out."""

    heads: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    omitted: int = 0


def page_of(report: Report) -> str:
    """Return a report as HTML."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rosrm_report", ""), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["clock"] = svg.clock
    environment.filters["plain"] = _plain
    style = environment.get_template("page.css").render()
    return str(environment.get_template("page.html").render(style=style, **_content(report)))


def _content(report: Report) -> Mapping[str, Any]:
    hosts = [one.host for one in report.hosts]
    spans = [*report.gone, *report.over_limit]
    readings = report.readings
    return {
        "report": report,
        "version": __version__,
        "began": datetime.fromtimestamp(report.began, timezone.utc).strftime("%Y-%m-%d %H:%M:%S"),
        "facts": _facts(report),
        "timeline": svg.timeline(
            hosts, report.placements, report.moves, report.failures, spans, report.length
        ),
        "usage": [
            (resource, svg.usage(readings, resource, hosts, report.length))
            for resource in readings.usage
        ]
        if readings is not None
        else [],
        "queue": svg.queue(report.queue, report.length),
        "legend": [(host, at % 8) for at, host in enumerate(hosts[: svg.MOST_CURVES])],
        "failures": report.failures[:MOST_ROWS],
        "more_failures": max(0, len(report.failures) - MOST_ROWS),
        "tables": _tables(report),
    }


def _facts(report: Report) -> Sequence[tuple[str, str]]:
    """Return the most important numbers, each with its name."""
    states = list(report.outcomes.values())
    waits = sorted(one.seconds for one in report.waits)
    done = _moved(report)
    replaced = sum(one.done and one.within for one in report.moves)
    rest = len(report.moves) - done - replaced
    facts = [
        ("duration", duration(report.length)),
        ("hosts", str(len(report.hosts))),
        ("processes", str(len(states))),
        *((state, str(states.count(state))) for state in ("finished", "failed", "cancelled")),
        ("moves", f"{done}" + (f" and {rest} that failed" if rest else "")),
        *([("replaced on their host", str(replaced))] if replaced else []),
        ("failures", str(len(report.failures))),
        ("longest queue", str(max((one for _, one in report.queue), default=0))),
    ]
    if waits:
        facts.append(("wait", f"median {duration(median(waits))}, at most {duration(waits[-1])}"))
    return facts


def _tables(report: Report) -> Mapping[str, Table]:
    return {
        "hosts": _hosts(report),
        "placements": _table(
            ("process", "host", "from", "to", "duration", "ended by"),
            (
                (one.process, one.host, svg.clock(one.begin), svg.clock(one.end),
                 duration(one.end - one.begin), one.ended_by.replace("_", " ") or "-")
                for one in report.placements
            ), len(report.placements), _MOST_PLACEMENTS,
        ),
        "moves": _table(
            ("time", "process", "from", "to", "how", "duration", "cause"),
            (
                (svg.clock(one.time), one.process, one.source,
                 _destination(one), one.how,
                 "-" if one.seconds is None else duration(one.seconds), one.cause)
                for one in report.moves
            ), len(report.moves),
        ),
        "faults": _table(
            ("time", "level", "kind", "host", "process", "message"),
            (
                (svg.clock(one.time), one.level, one.kind.replace("_", " "), one.host, one.process,
                 one.message)
                for one in sorted(report.faults, key=lambda one: (one.level != "ERROR", one.time))
            ), len(report.faults),
        ),
        "starts": _table(
            ("process", "host", "assigned at", "until it ran"),
            (
                (one.process, one.host, svg.clock(one.time), duration(one.seconds))
                for one in sorted(report.starts, key=lambda one: -one.seconds)
            ), len(report.starts), 20,
        ),
        "decisions": _table(
            ("time", "process", "host", "score", "second", "its score"),
            (
                (svg.clock(one.time), one.process, one.host, f"{one.score:.4f}", one.second,
                 f"{one.second_score:.4f}")
                for one in sorted(
                    report.close_decisions, key=lambda one: abs(one.second_score - one.score)
                )
            ), len(report.close_decisions), 20,
        ),
        "waits": _table(
            ("process", "from", "waited", "reason"),
            (
                (one.process, svg.clock(one.begin),
                 duration(one.seconds) + ("" if one.over else " so far"), one.reason or "-")
                for one in sorted(report.waits, key=lambda one: -one.seconds)
            ), len(report.waits), 20,
        ),
    }  # fmt: skip


def _moved(report: Report) -> int:
    """Return the number of processes that came to another host."""
    return sum(one.done and not one.within for one in report.moves)


def _destination(move: Move) -> str:
    if not move.done:
        return f"stayed (to {move.destination})"
    return "the same host" if move.within else move.destination


def _hosts(report: Report) -> Table:
    resources = sorted(report.readings.usage) if report.readings is not None else []
    heads = (
        "host", "assignments", "moves away", "moves to it", "failures", "over a limit",
        *(f"{one}, peak" for one in resources),
    )  # fmt: skip
    rows = [
        (one.host, str(one.assignments), str(one.moves_from), str(one.moves_to),
         str(one.failures), duration(one.over_limit),
         *(f"{one.peaks.get(name, 0.0) * 100:.0f} %" for name in resources))
        for one in report.hosts
    ]  # fmt: skip
    return _table(heads, rows, len(rows))


def _table(
    heads: tuple[str, ...], rows: Iterable[Sequence[str]], count: int, most: int = MOST_ROWS
) -> Table:
    shown = [[_plain(cell) for cell in row] for _, row in zip(range(most), rows, strict=False)]
    return Table(heads, shown, count - len(shown))


def _plain(text: str) -> str:
    return sanitized(text, _MOST_TEXT, lines=True)


def summary(report: Report) -> str:
    """Return the run in one line."""
    done = _moved(report)
    parts = [
        counted(len(report.outcomes), "process", "processes"), counted(len(report.hosts), "host"),
        counted(done, "move"), counted(len(report.failures), "failure"),
    ]  # fmt: skip
    return f"{', '.join(parts)} in {duration(report.length)}"
