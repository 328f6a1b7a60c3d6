"""Hand-made runs for the tests of reports."""

from __future__ import annotations

from rosrm.model.rows import EventRow
from rosrm_report.extract import report_of
from rosrm_report.model import Material, Readings, Report

BEGAN = 1.7e9


def events(*lines: tuple) -> list[EventRow]:
    """Return events of (seconds, kind, process, host, message, facts); all but two may lack."""
    rows = []
    for number, (at, kind, *rest) in enumerate(lines, 1):
        process, host, message, facts = (*rest, *("", "", "", {})[len(rest) :])
        rows.append(EventRow(number, BEGAN + at, float(at), kind, process, host, message, facts))
    return rows


def report(*lines: tuple, readings: Readings | None = None) -> Report:
    """Return the report of a run."""
    return report_of(Material("night", events(*lines), readings))


def decision(**scores: float | None) -> dict:
    """Return the facts of an assignment with the scores of the hosts."""
    hosts = [{"name": name, "score": score} for name, score in scores.items()]
    return {"number": 1, "decision": {"kind": "assigned", "hosts": hosts}}


READINGS = Readings(
    (0.0, 1.0, 2.0), {"memory": {"a": (0.1, 0.9, None), "b": (None, 0.2, 0.3)}},
    {"memory": {"a": 0.8, "b": 0.8}},
)  # fmt: skip
