"""Tables of the page: hosts, processes and events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from nicegui import ui

from rosrm_web.page.rows import Row, changed

#: Cells have text, never HTML: names and messages come from other machines.
_OPTIONS: Final = {
    ":getRowId": "params => params.data.id",
    "defaultColDef": {"sortable": True, "resizable": True, "filter": True},
    "rowSelection": {"mode": "singleRow", "checkboxes": False, "enableClickSelection": True},
    "animateRows": False,
    "suppressCellFocus": False,
    "ensureDomOrder": True,
}
#: A colour and a weight, because some users cannot tell these colours apart.
_STATE: Final = {
    "field": "state",
    "headerName": "State",
    "cellClassRules": {f"rosrm-{style}": f"data.style === '{style}'" for style in ("bad", "poor")},
    "width": 130,
}


def column(name: str, title: str = "", **options: Any) -> dict[str, Any]:
    """Return a column whose title is its name by default."""
    return {"field": name, "headerName": title or name.capitalize(), **options}


def usage(name: str, title: str = "") -> dict[str, Any]:
    """Return a column with a bar of the usage, and a mark at the limit."""
    share, limit = f"params.data.{name}_share", f"params.data.{name}_limit"
    colour = f"({share} > {limit} ? 'var(--rosrm-over)' : 'var(--rosrm-bar)')"
    bar = f"`linear-gradient(to right, ${{{colour}}} ${{100 * {share}}}%, transparent 0)`"
    mark = (
        f"`linear-gradient(to right, transparent ${{100 * {limit}}}%, currentColor 0 "
        f"calc(${{100 * {limit}}}% + 2px), transparent 0)`"
    )
    style = f"params => ({{backgroundImage: {mark} + ',' + {bar}}})"
    return {**column(name, title, width=150), ":cellStyle": style}


HOSTS: Final = (
    column("host", width=150),
    _STATE,
    column("processes", width=110),
    usage("cpu", "CPU"),
    usage("memory"),
    usage("disk"),
    column("more", "Other resources", width=180),
    column("labels", flex=1, minWidth=160),
)
PROCESSES: Final = (
    column("application", width=140, sort="asc", sortIndex=0),
    column("process", width=190, sort="asc", sortIndex=1),
    _STATE,
    column("host", width=130),
    column("cpu", "CPU", width=80),
    column("memory", width=100),
    column("restarts", width=100),
    column("why", flex=1, minWidth=200),
)
EVENTS: Final = (
    column("sequence", "Number", width=100, sort="desc"),
    {
        **column("time", width=120),
        ":valueFormatter": "params => new Date(params.value * 1000).toLocaleTimeString()",
    },
    column("kind", width=170),
    column("process", width=160),
    column("host", width=130),
    column("message", flex=1, minWidth=240, wrapText=True, autoHeight=True),
)


class Table:
    """A grid that gets only the rows that changed.

    Args:
        columns: of AG Grid.
        label: for screen readers.
        on_select: called with the id of a row that the user chooses; None: rows are not chosen.
    """

    def __init__(
        self, columns: Sequence[Mapping[str, Any]], label: str,
        on_select: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        self._shown: dict[str, Row] | None = None
        options = {**_OPTIONS, "columnDefs": list(columns), "rowData": []}
        self._grid = ui.aggrid(options, theme="quartz", auto_size_columns=False)
        self._grid.classes("w-full rosrm-grid").props(f'aria-label="{label}"')
        if on_select is not None:
            self._grid.on("cellDoubleClicked", lambda event: on_select(event.args["data"]["id"]))

    def show(self, rows: Mapping[str, Row]) -> None:
        """Show rows by their ids."""
        if self._shown is None:
            self._grid.options["rowData"] = list(rows.values())
        elif change := changed(self._shown, rows):
            self._grid.run_grid_method("applyTransaction", change.transaction())
        self._shown = dict(rows)

    def narrow(self, **values: str) -> None:
        """Show only rows with these values of columns; without values, all rows."""
        model = {
            name: {"filterType": "text", "type": "startsWith", "filter": value}
            for name, value in values.items()
        }
        self._grid.run_grid_method("setFilterModel", model or None)
