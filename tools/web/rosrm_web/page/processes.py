"""The table of processes: a tree with a search."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from nicegui import ui

from rosrm.model.rows import ProcessRow
from rosrm.wording import counted
from rosrm_web.page.tree import MOST_OPEN, Choice, Folding, is_group, tree_rows
from rosrm_web.page.views import STATE, Table, column

#: Name with its indentation, and for a group a mark that shows if it is open. A screen reader gets
#: both from the row, so each change of the row renders the cell again.
_NAME: Final = """params => {
  const row = params.eGridCell.closest(".ag-row"), {level, open} = params.data;
  row.closest("[role=grid]")?.setAttribute("role", "treegrid");
  row.setAttribute("aria-level", level);
  if (open !== undefined) row.setAttribute("aria-expanded", open);
  const mark = document.createElement("span");
  mark.className = "rosrm-mark";
  mark.ariaHidden = "true";
  mark.textContent = open === undefined ? "" : open ? "▾" : "▸";
  const cell = document.createElement("span");
  cell.style.paddingLeft = `${1.2 * (level - 1)}em`;
  cell.append(mark, params.value);
  return cell;
}"""
#: Sorts siblings only, groups first: the members of a group stay behind it.
_SORT: Final = """params => {
  const below = new Map();
  for (const node of params.nodes) {
    const parent = node.data.parent;
    below.has(parent) ? below.get(parent).push(node) : below.set(parent, [node]);
  }
  params.nodes.length = 0;
  const isProcess = node => Number(node.data.open === undefined);
  const add = parent => {
    const siblings = below.get(parent) ?? [];
    for (const node of siblings.sort((a, b) => isProcess(a) - isProcess(b))) {
      params.nodes.push(node);
      add(node.data.id);
    }
  };
  add("");
}"""
_COLUMNS: Final = (
    {
        **column("process", width=260, sort="asc"),
        ":cellRenderer": _NAME,
        ":equals": "() => false",
        ":comparator": "new Intl.Collator('en', {numeric: true}).compare",
        # Otherwise the grid would move the focus to the next cell.
        ":suppressKeyboardEvent": "params => params.data.open === false"
        " && params.event.key === 'ArrowRight'",
    },
    {**STATE, "width": 200},
    column("host", width=130),
    {**column("cpu", "CPU", width=80), ":comparator": "(a, b) => Number(a) - Number(b)"},
    {
        **column("memory", width=100),
        ":comparator": "(a, b, one, other) => one.data.bytes - other.data.bytes",
    },
    column("restarts", width=100),
    column("why", flex=1, minWidth=200),
)
#: A filter of a column would hide the groups.
_OPTIONS: Final = {
    "defaultColDef": {"sortable": True, "resizable": True}, ":postSortRows": _SORT,
}  # fmt: skip


class Processes:
    """The processes that a user has chosen, as a tree.

    Args:
        on_open: called with the name of a process that the user opens.
    """

    def __init__(self, on_open: Callable[[str], None]) -> None:
        self._rows: Sequence[ProcessRow] | None = None
        self._choice = Choice()
        self._folding = self._unsearched = Folding()
        with ui.row().classes("w-full items-center px-2 rosrm-tools"):
            self._search = ui.input("Search processes", on_change=self._on_search)
            self._search.props("dense clearable debounce=200")
            for title, is_open in (("Expand all", True), ("Collapse all", False)):
                ui.button(
                    title,
                    color=None,
                    on_click=lambda is_open=is_open: self._fold_all(is_open=is_open),
                ).props("flat dense no-caps")
            self._count = ui.label().props("role=status")
        self._table = _Tree(on_open, self._toggle)

    def show(self, processes: Sequence[ProcessRow]) -> None:
        """Show a newer listing."""
        if processes is self._rows:
            return  # only the hosts were read again
        if self._rows is None:
            self._unsearched.default = len(processes) <= MOST_OPEN
        self._rows = processes
        self._draw()

    def choose(self, choice: Choice) -> None:
        """Show only some processes, with all their groups open."""
        self._choice = choice
        self._folding = Folding() if choice else self._unsearched
        if self._search.value != choice.text:
            self._search.value = choice.text
        self._draw()

    def _on_search(self) -> None:
        text = (self._search.value or "").strip()
        if text != self._choice.text:
            self.choose(Choice(self._choice.state, text))

    def _toggle(self, group: str) -> None:
        self._folding.touched[group] = not self._folding.is_open(group)
        self._draw()

    def _fold_all(self, *, is_open: bool) -> None:
        self._folding.set_all(is_open=is_open)
        self._draw()

    def _draw(self) -> None:
        rows = self._rows or ()
        chosen = [row for row in rows if self._choice.admits(row)] if self._choice else rows
        self._table.show(tree_rows(chosen, self._folding))
        total = counted(len(rows), "process", "processes")
        self._count.text = f"{len(chosen)} of {total}" if self._choice else total


class _Tree(Table):
    """A grid whose rows are groups and processes."""

    def __init__(
        self, on_open: Callable[[str], None], on_toggle: Callable[[str], None]
    ) -> None:  # fmt: skip
        super().__init__(_COLUMNS, "Processes", on_open, _OPTIONS)
        self._on_toggle = on_toggle
        self.grid.on("cellClicked", lambda event: self._take_click(event.args))

    def _open(self, row_id: str) -> None:
        if not is_group(row_id):
            super()._open(row_id)

    def _take_click(self, event: Mapping[str, Any]) -> None:
        if event["colId"] == "process" and is_group(event["data"]["id"]):
            self._on_toggle(event["data"]["id"])

    def take_key(self, key: str, id: str, column: str) -> None:  # noqa: A002 - as sent
        """Open or close a group, go to the parent, or open a process."""
        row = (self.shown or {}).get(id)
        if row is None:
            return
        if key == "Enter" and is_group(id):
            self._on_toggle(id)
        elif key == "Enter":
            self._open(id)
        elif column == "process" and row.get("open") is (key == "ArrowLeft"):
            self._on_toggle(id)
        elif column == "process" and key == "ArrowLeft" and row["parent"]:
            self._focus(row["parent"])

    def _focus(self, row_id: str) -> None:
        grid, name = f"getElement({self.grid.id}).api", json.dumps(row_id)
        ui.run_javascript(
            f"const grid = {grid}, node = grid.getRowNode({name});"
            "if (node) { grid.ensureNodeVisible(node);"
            " grid.setFocusedCell(node.rowIndex, 'process'); }"
        )
