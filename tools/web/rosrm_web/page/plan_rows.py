"""Cells and sentences on planned changes of applications. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

from rosrm.cli.output import applications, modes
from rosrm.model.applications import Action, ApplicationRow, PlannedAction
from rosrm.model.modes import ModeRow
from rosrm.wording import listed
from rosrm_web.page.rows import Row

#: Actions that interrupt a running process, and their effect on it.
_INTERRUPTIONS: Final = {
    Action.STOP: ("is stopped", "are stopped"),
    Action.REPLACE: ("is replaced", "are replaced"),
}
_APPLICATION: Final = ("name", "state", "version", "running", "why")
_MODE: Final = ("name", "state", "applications", "settings", "when", "why")
_STYLES: Final = {"degraded": "bad", "paused": "bad", "returning": "poor"}


def summary(actions: Iterable[PlannedAction]) -> str:
    """Return the numbers of actions: "start 2, stop 1"."""
    numbers = Counter(one.action for one in actions)
    return ", ".join(f"{kind.value} {numbers[kind]}" for kind in Action if numbers[kind])


def interruptions(actions: Sequence[PlannedAction]) -> str:
    """Return a sentence on the running processes that a plan interrupts; "": none."""
    phrases = []
    for action, (singular, plural) in _INTERRUPTIONS.items():
        names = [one.process for one in actions if one.action is action and one.before]
        if names:
            phrases.append(f"{listed(names)} {singular if len(names) == 1 else plural}")
    return f"{'; '.join(phrases)}." if phrases else ""


def application_rows(rows: Iterable[ApplicationRow]) -> dict[str, Row]:
    """Return the rows of the table of applications by their ids."""
    return {
        row.name: {
            "id": row.name,
            "style": _STYLES.get(row.state, ""),
            **dict(zip(_APPLICATION, applications.application_cells(row), strict=True)),
        }
        for row in rows
    }


def mode_rows(rows: Iterable[ModeRow]) -> dict[str, Row]:
    """Return the rows of the table of modes by their ids."""
    return {
        row.name: {"id": row.name, **dict(zip(_MODE, modes.mode_cells(row), strict=True))}
        for row in rows
    }
