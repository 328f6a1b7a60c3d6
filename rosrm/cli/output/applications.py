"""Tables and messages on applications."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table
from rich.text import Text

from rosrm.cli.output.plain import echo
from rosrm.cli.output.tables import state, table
from rosrm.model.applications import ApplicationRow, PlannedAction
from rosrm.wording import counted, few, listed, local_time


def actions(rows: Sequence[PlannedAction]) -> Table:
    """Return the table of a plan."""
    made = table("ACTION", "PROCESS", "HOST", "WHY")
    for row in rows:
        made.add_row(*map(Text, action_cells(row)))
    return made


def action_cells(row: PlannedAction) -> tuple[str, str, str, str]:
    """Return action, process, host and reason of a planned action."""
    moves = row.before and row.host and row.before != row.host
    host = f"{row.before} -> {row.host}" if moves else row.host or row.before
    return row.action.value, row.process, host, _why(row)


def _why(row: PlannedAction) -> str:
    """Return the reason of an action: changed fields, the placement, why it will wait."""
    changed = f"changed: {listed(row.fields)}" if row.fields else ""
    waits = f"will wait: {row.waits}" if row.waits else ""
    hosts = row.decision["hosts"] if row.decision is not None else ()
    placed = next((one["reason"] for one in hosts if one["verdict"] == "chosen"), "")
    return "; ".join(filter(None, (row.reason, changed, waits, placed)))


def applications(rows: Sequence[ApplicationRow]) -> Table:
    """Return the table of `rosrm apps`."""
    made = table("NAME", "STATE", "VERSION", "RUNNING", "WHY", right=("VERSION", "RUNNING"))
    for row in rows:
        name, condition, *others = application_cells(row)
        made.add_row(Text(name), state(condition), *map(Text, others))
    return made


def application_cells(row: ApplicationRow) -> tuple[str, str, str, str, str]:
    """Return name, state, version, running processes and reason of an application."""
    running = f"{row.running}/{row.processes}"
    return row.name, row.state, str(row.version or "-"), running, row.reason or _pending(row)


def versions(application: ApplicationRow) -> Table:
    """Return the table of `rosrm history`, the newest version first."""
    made = table("VERSION", "REQUESTED", "BY", "PROCESSES", "NOTE", right=("VERSION", "PROCESSES"))
    for cells in version_cells(application):
        made.add_row(*map(Text, cells))
    return made


def version_cells(application: ApplicationRow) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield number, time, principal, processes and note of each version, the newest first."""
    for row in reversed(application.versions):
        when = local_time(row.wall_time)
        given_up = f"given up: {row.given_up}" if row.given_up else ""
        wanted = _standing(application) if row.wanted else ""
        note = "; ".join(filter(None, (wanted, row.note, given_up)))
        yield str(row.number), when, row.by, str(row.processes), note


def _standing(row: ApplicationRow) -> str:
    """Return the note on the desired version."""
    if row.state == "running":
        return "desired"
    return f"desired, {row.state}" + (f": {row.reason}" if row.reason else "")


def _pending(row: ApplicationRow) -> str:
    """Return the processes that are not yet as desired, with the reasons."""
    phrases = [f"{name}: {why}" if why else name for name, why in row.pending.items()]
    return "; ".join(few(phrases))


def show_progress(row: ApplicationRow) -> None:
    """Print how many processes of an application are not yet as desired."""
    left = counted(len(row.pending), "process", "processes")
    version = f" version {row.version}" if row.version else ""
    echo(f"{row.name}{version}: {left} to go: {_pending(row)}", err=True)


def show_end(row: ApplicationRow, requested: int = 0) -> bool:
    """Print the state of an application; return True if it is as requested.

    `requested`: number of the requested version; 0: unknown.
    """
    given_up = row.returned_from
    why = row.reason or _pending(row)
    is_done = row.state in ("running", "cancelled")
    if given_up is not None and requested in (0, given_up.number):
        is_done, why = False, f"version {given_up.number} was given up: {given_up.given_up}"
    elif requested not in (0, row.version):
        is_done, why = False, f"another request has replaced version {requested}"
    version = f" at version {row.version}" if row.version else ""
    text = f"{row.name} is {row.state}{version}" + (f": {why}" if why else "")
    if row.state in ("applying", "returning"):
        text = f"--timeout has passed: {text} (`rosrm explain PROCESS` gives the details)"
    echo(text if is_done else f"rosrm: {text}", err=not is_done)
    return is_done
