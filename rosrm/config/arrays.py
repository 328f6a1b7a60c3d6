"""Indexes of an array in a work file, and the names of its jobs.

array: 1-100                   # or 0-9, 1-100:10 in steps, or a list: [1, 4, 9]
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from rosrm.config.checking import described
from rosrm.config.documents import Node, Problems
from rosrm.model.arrays import INDEX_PLACEHOLDER, LARGEST_INDEX

_RANGE: Final = re.compile(r"\s*(\d{1,18})\s*-\s*(\d{1,18})\s*(?::\s*(\d{1,18})\s*)?")
_WANTED: Final = "a range such as 1-100, or 1-100:10 in steps, or a list such as [1, 4, 9]"
#: Characters between the name of an array and the index in the name of its jobs.
_BETWEEN: Final = "-_."


def checked_indexes(node: Node, most: int, problems: Problems) -> Sequence[int]:
    """Return the indexes of an array, or note the problem and return none.

    `most`: highest number of indexes.
    """
    try:
        indexes = _indexes(node)
        _check(indexes, most)
    except ValueError as fault:
        problems.add(node.place, f"array: {fault}")
        return ()
    return indexes


def _indexes(node: Node) -> Sequence[int]:
    if isinstance(node.value, tuple):
        indexes = node.plain()
        strange = [one for one in indexes if not isinstance(one, int) or isinstance(one, bool)]
        if strange:
            raise ValueError(f"a list of whole numbers is required; {strange[0]!r} is none")
        return tuple(indexes)
    found = _RANGE.fullmatch(node.value) if isinstance(node.value, str) else None
    if found is None:
        raise ValueError(f"{_WANTED} is required, not {described(node.plain())}")
    first, last, step = int(found[1]), int(found[2]), int(found[3] or 1)
    if first > last:
        raise ValueError(
            f"{node.value}: the first index is above the last one; write {last}-{first}"
        )
    if step == 0:
        raise ValueError(f"{node.value}: a step of 0")
    return range(first, last + 1, step)


def _check(indexes: Sequence[int], most: int) -> None:
    if not indexes:
        raise ValueError(f"no index; {_WANTED} is required")
    if len(indexes) > most:
        raise ValueError(f"makes {len(indexes)} processes; at most {most} are allowed")
    for index in (min(indexes), max(indexes)):
        if not 0 <= index <= LARGEST_INDEX:
            raise ValueError(f"the index {index} is not within 0..{LARGEST_INDEX}")
    index, times = Counter(indexes).most_common(1)[0]
    if times > 1:
        raise ValueError(f"the index {index} is given {times} times")


def as_member(made: Node, index: int, entry: Node, filled: Callable[[str], str]) -> Node:
    """Return the entry of one job of an array, with its name and its membership.

    A name without `{array.index}` gets the index at its end: `render-17`.

    Args:
        made: the entry with the index in its texts.
        index: index of the job.
        entry: the entry of the array.
        filled: returns a text with the values of `foreach`.
    """
    name, place = entry.get("name"), entry.items["array"].place
    array = text = name.value if name is not None and isinstance(name.value, str) else ""
    members = dict(made.items)
    if INDEX_PLACEHOLDER.search(text):
        array = INDEX_PLACEHOLDER.sub("", text).strip(_BETWEEN)
    elif name is not None:
        members["name"] = Node(f"{filled(text)}-{index}", name.place, name.key_place)
    membership = (Node(filled(array), place), Node(index, place))
    members["array"] = Node(membership, place, entry.items["array"].key_place)
    return Node(members, made.place)
