"""Processes as a tree: application, namespace or array, process. Pure."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from rosrm.model.rows import ProcessRow
from rosrm.wording import counted, words
from rosrm_web.page.rows import PROCESS_TROUBLE, Row, process_row, usage_cells

#: Processes above which groups are closed at first.
MOST_OPEN: Final = 200
#: End of the id of a group; no name of a process has it.
_MARK: Final = "/"


@dataclass(frozen=True, slots=True)
class Choice:
    """Condition on the processes that are shown.

    Attributes:
        state: of each of them; "": any.
        text: part of the name, application, host, state or reason, in upper or lower case; "": any.
    """

    state: str = ""
    text: str = ""

    def __bool__(self) -> bool:
        return bool(self.state or self.text)

    def admits(self, row: ProcessRow) -> bool:
        """Return True if a process is shown."""
        if self.state not in ("", row.state):
            return False
        text = self.text.casefold()
        texts = (row.name, row.application, row.host, words(row.state), row.reason)
        return not text or any(text in one.casefold() for one in texts)


@dataclass
class Folding:
    """Groups that are open or closed.

    Attributes:
        default: groups that the user has not touched are open.
        touched: id of each other group, and True if it is open.
    """

    default: bool = True
    touched: dict[str, bool] = field(default_factory=dict)

    def is_open(self, group: str) -> bool:
        """Return True if the members of a group are shown."""
        return self.touched.get(group, self.default)

    def set_all(self, *, is_open: bool) -> None:
        """Open or close all groups."""
        self.default = is_open
        self.touched.clear()


def is_group(row_id: str) -> bool:
    """Return True if a row is a group, and not a process."""
    return row_id.endswith(_MARK)


def tree_rows(processes: Iterable[ProcessRow], folding: Folding) -> dict[str, Row]:
    """Return the visible rows of a tree by their ids: groups, and processes of open groups."""
    members: defaultdict[tuple[str, ...], list[ProcessRow]] = defaultdict(list)
    shown: dict[str, Row] = {}
    for row in processes:
        path = _path(row)
        for depth in range(1, len(path) + 1):
            members[path[:depth]].append(row)
        if _is_visible(path, folding):
            shown[row.name] = {**process_row(row), **_place(path)}
    for path, rows in members.items():
        if _is_visible(path[:-1], folding):
            group = _id(path)
            is_open = folding.is_open(group)
            shown[group] = {**_group(path, rows), **_place(path[:-1]), "open": is_open}
    return shown


def _path(row: ProcessRow) -> tuple[str, ...]:
    """Return the titles of the groups of a process, the outermost first."""
    namespace = row.name.rpartition(".")[0].replace(".", "/")
    inner = f"array {row.array}" if row.array else namespace and f"/{namespace}"
    return tuple(filter(None, (row.application, inner)))


def _id(path: Sequence[str]) -> str:
    return "".join(title + _MARK for title in path)


def _is_visible(path: tuple[str, ...], folding: Folding) -> bool:
    return all(folding.is_open(_id(path[:depth])) for depth in range(1, len(path) + 1))


def _place(path: Sequence[str]) -> Row:
    """Return the members of a row below a group."""
    return {"level": len(path) + 1, "parent": _id(path)}


def _group(path: Sequence[str], rows: Sequence[ProcessRow]) -> Row:
    """Return a row with the sums of its processes."""
    states = Counter(row.state for row in rows)
    hosts = sorted({row.host for row in rows if row.host})
    return {
        "id": _id(path),
        "process": path[-1],
        "state": ", ".join(f"{number} {words(state)}" for state, number in states.most_common()),
        "style": next(iter(_styles(states)), ""),
        "host": hosts[0] if len(hosts) == 1 else counted(len(hosts), "host") if hosts else "",
        **usage_cells(sum(row.cpu for row in rows), sum(row.memory for row in rows)),
        "restarts": sum(row.restarts for row in rows) or "",
        "why": "",
    }


def _styles(states: Iterable[str]) -> Iterator[str]:
    """Yield the styles of states that are not well, the gravest first."""
    present = set(states)
    return (style for state, style in PROCESS_TROUBLE.items() if state in present)
