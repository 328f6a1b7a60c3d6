"""Tables of the page: their common behaviour, and the columns of hosts and events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from nicegui import ui

from rosrm.model.values import EMPTY
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
STATE: Final = {
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


def time_column(**options: Any) -> dict[str, Any]:
    """Return a column with a unix time as a time of day."""
    return {
        **column("time", width=120, **options),
        ":valueFormatter": "params => new Date(params.value * 1000).toLocaleTimeString()",
    }


HOSTS: Final = (
    column("host", width=150, sort="asc"),
    STATE,
    column("processes", width=130),
    usage("cpu", "CPU"),
    usage("memory"),
    usage("disk"),
    column("more", "Other resources", width=150),
    column("devices", width=150),
    column("labels", flex=1, minWidth=160),
)
EVENTS: Final = (
    column("sequence", "Number", width=100, sort="desc"),
    time_column(),
    column("kind", width=170),
    column("process", width=160),
    column("host", width=130),
    column("message", flex=1, minWidth=240, wrapText=True, autoHeight=True),
)


#: Sends the keys that act on a row; the grid itself moves between cells.
_KEYS: Final = """(event) => {
  const cell = event.target.closest(".ag-cell"), row = event.target.closest(".ag-row");
  if (cell && row && ["Enter", "ArrowLeft", "ArrowRight"].includes(event.key))
    emit({key: event.key, id: row.getAttribute("row-id"), column: cell.getAttribute("col-id")});
}"""


class Table:
    """A grid that gets only the rows that changed.

    Args:
        columns: of AG Grid.
        label: for screen readers.
        on_open: called with the id of a row after a double click, or Enter; None: rows do not open.
        options: further ones of AG Grid.
    """

    def __init__(
        self, columns: Sequence[Mapping[str, Any]], label: str,
        on_open: Callable[[str], None] | None = None, options: Mapping[str, Any] = EMPTY,
    ) -> None:  # fmt: skip
        self.shown: dict[str, Row] | None = None
        self._is_mounted = False
        merged = {**_OPTIONS, **options, "columnDefs": list(columns)}
        self.grid = ui.aggrid(merged, theme="quartz", auto_size_columns=False)
        self.grid.classes("w-full rosrm-grid").props(f'aria-label="{label}"')
        self._on_open = on_open
        self.grid.on("gridReady", self._mount, [])
        self.grid.on("cellDoubleClicked", lambda event: self._open(event.args["data"]["id"]))
        self.grid.on("keydown", lambda event: self.take_key(**event.args), js_handler=_KEYS)

    def _mount(self) -> None:
        """Send all rows, because a browser makes a grid only when it first shows its tab."""
        self._is_mounted = True
        self._send_all()

    def _send_all(self) -> None:
        if self._is_mounted and self.shown is not None:
            self.grid.run_grid_method("setGridOption", "rowData", list(self.shown.values()))

    def _open(self, row_id: str) -> None:
        if self._on_open is not None:
            self._on_open(row_id)

    def take_key(self, key: str, id: str, column: str) -> None:  # noqa: A002, ARG002 - as sent
        """React to a key in a cell of a row."""
        if key == "Enter":
            self._open(id)

    def show(self, rows: Mapping[str, Row]) -> None:
        """Show rows by their ids."""
        before, self.shown = self.shown, dict(rows)
        if before is None:
            self._send_all()
        elif self._is_mounted and (change := changed(before, rows)):
            self.grid.run_grid_method("applyTransaction", change.transaction())

    def narrow(self, **values: str) -> None:
        """Show only rows with these values of columns; without values, all rows."""
        model = {
            name: {"filterType": "text", "type": "startsWith", "filter": value}
            for name, value in values.items()
        }
        self.grid.run_grid_method("setFilterModel", model or None)
