"""Output of `rosrm submit --trace`: the hand-overs of each start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table

from rosrm.cli.output import json_forms, tables
from rosrm.cli.output.plain import echo
from rosrm.client.start_traces import Trace, hand_overs

_NUMBERS = ("STEP ms", "SINCE SUBMIT ms")


def show(traces: Mapping[str, Trace], *, as_json: bool) -> None:
    """Print the traces of starts, by the names of their processes."""
    if as_json:
        json_forms.show(
            [
                {
                    "process": name,
                    "stamps": dict(trace),
                    "hand_overs": json_forms.forms(hand_overs([trace])),
                }
                for name, trace in traces.items()
            ]
        )
        return
    for name, trace in traces.items():
        if len(traces) > 1:
            echo(f"{name}:")
        tables.show(table([trace]))


def table(traces: Sequence[Trace]) -> Table:
    """Return the table of one start, or of the medians over several."""
    made = tables.table("HAND-OVER", *_NUMBERS, right=_NUMBERS)
    for row in hand_overs(traces):
        made.add_row(row.event, *map(_milliseconds, (row.step_ms, row.since_submit_ms)))
    return made


def _milliseconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
