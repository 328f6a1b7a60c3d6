"""Expansion of `foreach`: one entry of a work file for many similar processes.

    foreach: {i: "range(0, 60)", size: [small, large]}     # every pair: 120 processes
    foreach: [{i: 1, mb: 8}, {i: 2, mb: 80}]               # these two

In every text of the entry `{i}` is replaced by the value, and `{i:02d}` by the value in Python's
format. A text that consists of `{i}` alone becomes the value itself, number or text. `{{` is a
plain brace. `{device.camera}` and `{artifacts}` stay for the host that runs the process.

`array: 1-100` expands an entry in the same way, with `{array.index}` as its value, also beside
`foreach`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Final

from rosrm.config.arrays import as_member, checked_indexes
from rosrm.config.checking import described, near
from rosrm.config.documents import Node, Problems
from rosrm.model.arrays import INDEX
from rosrm.model.placeholders import PLACEHOLDER

#: Highest number of processes to which the entries of a file may expand.
MOST: Final = 10_000

Scalar = bool | int | float | str
Row = Mapping[str, Scalar]

_RANGE: Final = re.compile(
    r"range\(\s*(-?\d{1,18})\s*(?:,\s*(-?\d{1,18})\s*)?(?:,\s*(-?\d{1,18})\s*)?\)"
)
_PIECE: Final = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]")
_TOO_WIDE: Final = re.compile(r"\d{4}")
_WHOLE: Final = re.compile(rf"\{{([A-Za-z_]\w*|{re.escape(INDEX)})\}}")


def all_expanded(entries: Iterable[Node], problems: Problems) -> Iterator[Node]:
    """Yield all entries of a file expanded; note a problem if they make too many processes."""
    made = 0
    for entry in entries:
        for node in expanded(entry, problems):
            made += 1
            if made > MOST:
                problems.add(entry.place, f"the file makes more than {MOST} processes")
                return
            yield node


def expanded(entry: Node, problems: Problems) -> Iterator[Node]:
    """Yield the entry itself or, with `foreach` or `array`, one entry for each row or index."""
    foreach, array = entry.get("foreach"), entry.get("array")
    if foreach is None and array is None:
        yield entry
        return
    rows = [{}] if foreach is None else _checked_rows(foreach, problems)
    indexes = [None] if array is None else checked_indexes(array, MOST, problems)
    if array is not None and len(rows) * len(indexes) > MOST:
        problems.add(array.place, f"array: makes more than {MOST} processes with `foreach`")
        return
    for row, index in itertools.product(rows, indexes):
        faults = Problems()
        made = _made(entry, row, index, faults)
        problems.found.update(faults.found)
        if not faults:
            yield made


def _made(entry: Node, row: Row, index: int | None, problems: Problems) -> Node:
    """Return the entry of one process."""
    own = {key: node for key, node in entry.items.items() if key not in ("foreach", "array")}
    values = row if index is None else {**row, INDEX: index}
    made = _substituted(Node(own, entry.place), values, problems)
    if index is None:
        return made
    name = entry.get("name")
    return as_member(
        made, index, entry, lambda text: str(_text(name or entry, text, row, problems))
    )


def _checked_rows(foreach: Node, problems: Problems) -> list[Row]:
    """Return the values of each process, or note all problems and return none."""
    faults = Problems()
    rows = _rows(foreach, faults)
    if not rows and not faults:
        faults.add(foreach.place, "foreach: makes no process")
    problems.found.update(faults.found)
    return [] if faults else rows


def _rows(foreach: Node, problems: Problems) -> list[Row]:
    if isinstance(foreach.value, tuple):
        rows = [_row(item, problems) for item in foreach.value]
        _check_same_names(foreach, rows, problems)
        return rows
    if foreach.items:
        names = {name: _values(name, node, problems) for name, node in foreach.items.items()}
        return _product(foreach, names, problems)
    wanted = "a mapping from a name to its values is required, such as {i: range(0, 60)}"
    problems.add(foreach.place, f"foreach: {wanted}, not {described(foreach.plain())}")
    return []


def _substituted(node: Node, row: Row, problems: Problems) -> Node:
    """Return a document with the values of one row substituted in all its texts and keys."""
    if isinstance(node.value, str):
        return Node(_text(node, node.value, row, problems), node.place, node.key_place)
    if isinstance(node.value, tuple):
        items = tuple(_substituted(item, row, problems) for item in node.value)
        return Node(items, node.place, node.key_place)
    if isinstance(node.value, Mapping):
        members = {
            str(_text(item, key, row, problems)): _substituted(item, row, problems)
            for key, item in node.items.items()
        }
        return Node(members, node.place, node.key_place)
    return node


def _row(item: Node, problems: Problems) -> Row:
    if not item.items:
        problems.add(item.place, "foreach: each entry of a list must map names to values")
    return {name: value for name, node in item.items.items() for value in _one(node, problems)}


def _check_same_names(foreach: Node, rows: list[Row], problems: Problems) -> None:
    items = foreach.value if isinstance(foreach.value, tuple) else ()
    for node, row in zip(items, rows, strict=True):
        if set(row) != set(rows[0]):
            problems.add(
                node.place,
                f"foreach: this entry has the names {', '.join(row)}, and the first entry "
                f"{', '.join(rows[0])}; all must have the same names",
            )


def _values(name: str, node: Node, problems: Problems) -> list[Scalar]:
    if not name.isidentifier():
        problems.add(node.key_place or node.place, f"foreach: {name!r} is not a name")
    if isinstance(node.value, str) and (found := _RANGE.fullmatch(node.value)):
        bounds = [int(bound) for bound in found.groups() if bound is not None]
        if len(bounds) == 3 and bounds[2] == 0:
            problems.add(node.place, f"foreach.{name}: a step of 0")
            return []
        return list(itertools.islice(range(*bounds), MOST + 1))
    if isinstance(node.value, tuple):
        return [value for item in node.value for value in _one(item, problems)]
    problems.add(
        node.place,
        f"foreach.{name}: a list or range(first, end) is required, not {described(node.plain())}",
    )
    return []


def _one(node: Node, problems: Problems) -> Iterator[Scalar]:
    if isinstance(node.value, (bool, int, float, str)):
        yield node.value
    else:
        problems.add(
            node.place, f"foreach: text or a number is required, not {described(node.plain())}"
        )


def _product(foreach: Node, names: Mapping[str, list[Scalar]], problems: Problems) -> list[Row]:
    count = 1
    for values in names.values():
        count *= len(values)
    if count > MOST:
        problems.add(foreach.place, f"foreach: makes more than {MOST} processes")
        return []
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*names.values())]


def _text(node: Node, text: str, row: Row, problems: Problems) -> Scalar:
    whole = _WHOLE.fullmatch(text)
    if whole and whole[1] in row:
        return row[whole[1]]

    def put(found: re.Match[str]) -> str:
        try:
            return _piece(found, row)
        except ValueError as error:
            problems.add(node.place, f"{text!r}: {error}")
            return found[0]

    return _PIECE.sub(put, text)


def _piece(found: re.Match[str], row: Row) -> str:
    if found[0] in ("{{", "}}"):
        return found[0][0]
    if found[1] is None:
        raise ValueError(f"a single brace; write {found[0] * 2} for a plain one")
    if PLACEHOLDER.fullmatch(found[0]):
        return found[0]  # the host fills it in
    name, _, form = found[1].partition(":")
    if name not in row:
        if name == INDEX:
            raise ValueError(f"{{{INDEX}}} needs `array` in the process")
        hint = "" if name.isidentifier() else "; write {{ and }} for plain braces"
        raise ValueError(f"unknown name {name!r}{near(name, list(row))}{hint}")
    return _formatted(row[name], form)


def _formatted(value: Scalar, form: str) -> str:
    if not _TOO_WIDE.search(form):
        with suppress(ValueError, OverflowError):
            return format(value, form)
    raise ValueError(f"{form!r} is no format for {described(value)}")
