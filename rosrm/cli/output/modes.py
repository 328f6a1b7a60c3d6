"""Tables and messages on modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from rosrm.cli.output.plain import echo
from rosrm.cli.output.tables import table
from rosrm.model.modes import ModeRow


def modes(rows: Sequence[ModeRow]) -> Table:
    """Return the table of `rosrm mode`."""
    made = table("MODE", "STATE", "APPLICATIONS", "SETTINGS", "WHEN", "WHY")
    for row in rows:
        made.add_row(*map(Text, mode_cells(row)))
    return made


def mode_cells(row: ModeRow) -> tuple[str, str, str, str, str, str]:
    """Return name, state, applications, settings, condition and reason of a mode."""
    settings = "; ".join(
        filter(None, (_amounts("limits", row.limits), _amounts("weights", row.weights)))
    )
    return row.name, row.state, ", ".join(row.applications), settings, row.when, row.reason


def _amounts(what: str, amounts: Mapping[str, float]) -> str:
    shown = ", ".join(f"{name} {amount:g}" for name, amount in amounts.items())
    return f"{what} {shown}" if shown else ""


def show_end(rows: Sequence[ModeRow], wanted: str) -> bool:
    """Print which mode is in force after a switch; return True if it is the wanted one."""
    row = next((one for one in rows if one.name == wanted), None)
    is_done = row is not None and row.state == "in force"
    others = [one.name for one in rows if one.state == "in force" and one.name != wanted]
    text = f"the mode {wanted} is {'' if is_done else 'not '}in force"
    why = f": {row.reason}" if row is not None and row.reason and not is_done else ""
    stays = f"; {others[0]} is" if others else ""
    echo(f"{'' if is_done else 'rosrm: '}{text}{stays}{why}", err=not is_done)
    return is_done
