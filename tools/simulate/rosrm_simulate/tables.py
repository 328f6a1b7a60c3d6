"""Output of `rosrm simulate`: a table for a terminal, and the same as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import typer
from rich.text import Text

from rosrm.cli.output import tables
from rosrm.model.codec import to_plain
from rosrm.wording import counted, few
from rosrm_simulate.agreement import Agreement
from rosrm_simulate.replay import Replay
from rosrm_simulate.runs import SimulationReport, SimulationRun

#: Number of never placed processes whose reason is shown.
_TOLD: Final = 3
#: Columns about the processes, and about the hosts: side by side where there is room.
_PROCESSES: Final = ("HOSTS", "PLACED", "DONE", "MAKESPAN", "WAIT", "LONGEST")
_HOSTS: Final = ("MEM GAP", "CPU GAP", "MOVES", "OVER LIMIT")
_WIDE: Final = 125


def show(report: SimulationReport) -> None:
    """Print the results of a command."""
    if report.recording is not None and report.replayed is not None:
        _say_of_record(report, report.replayed)
    is_wide = tables.console().width >= _WIDE
    halves = (_PROCESSES + _HOSTS,) if is_wide else (_PROCESSES, _HOSTS)
    for columns in halves:
        made = tables.table("RUN", *columns, right=columns)
        for run in report.runs:
            cells = _cells(run)
            made.add_row(Text(run.name), *(cells[column] for column in columns))
        tables.show(made)
    for run in report.runs:
        never = [f"{name}: {reason}" for name, reason in run.outcome.never_placed.items()]
        if never:
            some = "; ".join(few(never, _TOLD))
            typer.echo(f"{run.name}: {len(never)} never placed: {some}")
    if report.agreement is not None:
        for line in agreement_lines(report.agreement):
            typer.echo(line)
    simulated = [run for run in report.runs if run.seconds > 0.0]
    events = sum(run.outcome.events for run in simulated)
    seconds = sum(run.seconds for run in simulated)
    typer.echo(f"{counted(events, 'event')} in {seconds:.1f} s, {events / seconds:.0f} a second")


def _cells(run: SimulationRun) -> dict[str, str]:
    outcome = run.outcome
    failed = f" ({outcome.failed_migrations} failed)" if outcome.failed_migrations else ""
    return {
        "HOSTS": str(run.hosts),
        "PLACED": f"{len(outcome.placements)}/{outcome.processes}",
        "DONE": str(outcome.finished),
        "MAKESPAN": "-" if outcome.makespan is None else _seconds(outcome.makespan),
        "WAIT": _seconds(outcome.wait_mean),
        "LONGEST": _seconds(outcome.wait_max),
        "MEM GAP": f"{outcome.imbalance['memory'] * 100:.1f} %",
        "CPU GAP": f"{outcome.imbalance['cpu'] * 100:.1f} %",
        "MOVES": f"{outcome.migrations}{failed}",
        "OVER LIMIT": _seconds(outcome.over_limit),
    }


def _seconds(seconds: float) -> str:
    """Return a time in seconds, because minutes would hide differences between rows."""
    return f"{seconds:.1f} s" if seconds < 999.95 else f"{seconds:.0f} s"


def _say_of_record(report: SimulationReport, replayed: Replay) -> None:
    recording = report.recording
    assert recording is not None
    typer.echo(
        f"record of master {recording.header.master}, epoch {recording.header.epoch}: "
        f"{recording.length:.1f} s, {counted(len(recording.events), 'event')}, {recording.end}"
    )
    if not replayed.different:
        typer.echo(f"replayed: all {replayed.decisions} decisions are the same")
        return
    typer.echo(
        f"replayed: {counted(replayed.different, 'event')} led to other decisions; was the record "
        f"made by another version of rosrm or of a plugin?"
    )
    for difference in replayed.differences:
        typer.echo(f"  {difference}")


def agreement_lines(agreement: Agreement) -> Iterator[str]:
    """Yield the lines about the agreement of a simulation with its run."""
    same = round(agreement.same_host * agreement.processes)
    processes = counted(agreement.processes, "process", "processes")
    yield "The simulation compared with the recorded run:"
    yield f"  {same} of {processes} started on the same host"
    yield f"  {agreement.same_counts:.0%} match in how many started on each host"
    yield f"  moves: {agreement.migrations[0]} recorded, {agreement.migrations[1]} simulated"
    if agreement.makespan is not None:
        yield f"  makespan: {agreement.makespan:.2f} times the recorded one"
    yield f"  mean difference of the usage of a host: {_points(agreement.usage)}"
    yield f"  the same with hosts ordered from full to empty: {_points(agreement.ranked)}"
    yield f"  mean difference of the gap between full and empty: {_points(agreement.balance)}"


def _points(of: Mapping[str, float]) -> str:
    return f"memory {of['memory'] * 100:.1f}, CPU {of['cpu'] * 100:.1f} percentage points"


# --- JSON -------------------------------------------------------------------------------------


def report_form(report: SimulationReport) -> dict[str, Any]:
    """Return all numbers, as printed by `--json`."""
    replayed, recording = report.replayed, report.recording
    return {
        "workload": report.workload.name,
        "record": None
        if recording is None or replayed is None
        else {
            "master": recording.header.master,
            "epoch": recording.header.epoch,
            "seconds": recording.length,
            "events": len(recording.events),
            "end": recording.end,
            "decisions": replayed.decisions,
            "different": replayed.different,
            "differences": [str(one) for one in replayed.differences],
        },
        "runs": [_run_form(run) for run in report.runs],
        "agreement": None if report.agreement is None else to_plain(report.agreement),
    }


def _run_form(run: SimulationRun) -> dict[str, Any]:
    outcome = run.outcome
    kept = ("processes", "finished", "running", "waiting", "ended_otherwise", "never_placed",
            "makespan", "wait_mean", "wait_max", "migrations", "failed_migrations", "imbalance",
            "over_limit", "span", "placements", "arrivals", "ends", "events")  # fmt: skip
    return {
        "run": run.name,
        "hosts": run.hosts,
        **{name: to_plain(getattr(outcome, name)) for name in kept},
        "seconds": run.seconds,
    }
