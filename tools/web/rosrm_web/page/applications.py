"""The tab of applications and modes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from nicegui import background_tasks, ui

from rosrm.model.applications import ApplicationRow
from rosrm_web.page.plan_rows import application_rows, mode_rows
from rosrm_web.page.plans import ApplicationDialog, ModeDialog, WorkDialog
from rosrm_web.page.views import STATE, Table, column

if TYPE_CHECKING:
    from rosrm.model.rows import Listing
    from rosrm_web.gateway import Gateway

_APPLICATIONS: Final = (
    column("name", width=200, sort="asc"),
    STATE,
    column("version", width=110),
    column("running", width=110),
    column("why", flex=1, minWidth=200),
)
_MODES: Final = (
    column("name", "Mode", width=200),
    STATE,
    column("applications", flex=1, minWidth=160),
    column("settings", width=200),
    column("when", width=200),
    column("why", flex=1, minWidth=160),
)


class Applications:
    """Applications and modes, with the plans of their changes.

    Args:
        gateway: sends the requests.
        on_action: as of `Plan`.
        may_act: the user is an operator, and the gateway acts.
    """

    def __init__(
        self, gateway: Gateway, on_action: Callable[[str], None], *, may_act: bool
    ) -> None:  # fmt: skip
        self._rows: Mapping[str, ApplicationRow] = {}
        self._application = ApplicationDialog(gateway, on_action, may_act=may_act)
        self._mode = ModeDialog(gateway, on_action)
        if may_act:
            work = WorkDialog(gateway, on_action)
            with ui.row().classes("px-2 rosrm-tools"):
                ui.button("Plan a change", color=None, on_click=work.open).props(
                    "flat dense no-caps"
                )
        self._applications = Table(_APPLICATIONS, "Applications", self._open_application)
        self._modes = Table(_MODES, "Modes", self._open_mode if may_act else None)
        for table in (self._applications, self._modes):
            table.grid.classes("rosrm-half")

    def show(self, listing: Listing) -> None:
        """Show a newer listing."""
        self._rows = {row.name: row for row in listing.applications}
        self._applications.show(application_rows(listing.applications))
        self._modes.show(mode_rows(listing.modes))

    def _open_application(self, name: str) -> None:
        row = self._rows.get(name)
        if row is not None:
            self._application.open(row)

    def _open_mode(self, name: str) -> None:
        background_tasks.create(self._mode.open(name))
