"""The few lowest values of an array, kept while single values change."""

from __future__ import annotations

from bisect import insort
from math import inf
from typing import Final

import numpy as np

from rosrm.core.master.state.host_arrays import FloatArray

#: Number of columns that a caller gets: the best one, and the runners-up in an explanation.
WANTED: Final = 4
#: Number of columns that a search finds after single values have changed, to need fewer searches.
_AHEAD: Final = 8
#: Number of changed values above which a new search costs less; also the longest list.
MOST: Final = 12
#: `_ALL` sorts before each finite value, `_NONE` after each.
_ALL: Final = (-inf, -1)
_NONE: Final = (inf, -1)


class Shortlist:
    """The columns with the lowest finite values; of equal values, the lower column comes first.

    A search costs one pass for each column that it finds. A changed value is moved in the list, and
    causes a search only if too few columns are left.

    Args:
        value: (H,) values; inf: the column does not count. Only `put` may change them.
    """

    def __init__(self, value: FloatArray) -> None:
        self._value = value
        self._finite: int | None = None
        self._lowest: list[tuple[float, int]] = []
        self._end = _ALL  # each finite value that is not in the list comes after this one
        self._changed = False  # after a change, a search finds more columns than are wanted

    def lowest(self, wanted: int = WANTED) -> list[int]:
        """Return `wanted` columns with the lowest values, in order; fewer if no more are finite."""
        if len(self._lowest) < wanted and self._end is not _NONE:
            self._search(_AHEAD if self._changed else wanted)
        return [column for _, column in self._lowest[:wanted]]

    def finite(self) -> int:
        """Return the number of finite values."""
        if self._finite is None:
            self._finite = int(np.count_nonzero(self._value < inf))
        return self._finite

    def put(self, columns: list[int], values: list[float]) -> None:
        """Replace the values of some columns, each of which is given once."""
        self._changed = True
        for column, new in zip(columns, values, strict=True):
            old = float(self._value[column])
            self._value[column] = new
            if self._finite is not None:
                self._finite += (new < inf) - (old < inf)
            if new != old:
                self._move((old, column), (new, column))

    def _move(self, old: tuple[float, int], new: tuple[float, int]) -> None:
        lowest = self._lowest
        if old <= self._end:
            lowest.remove(old)
        if new <= self._end:
            insort(lowest, new)
        if len(lowest) > MOST:
            del lowest[_AHEAD:]
            self._end = lowest[-1]

    def _search(self, wanted: int) -> None:
        """Search for further columns until the list has `wanted`, or all with finite values."""
        value, found = self._value, self._lowest
        for _, column in found:
            value[column] = inf
        self._end = _NONE
        for _ in range(min(wanted, len(value)) - len(found)):
            column = int(value.argmin())
            lowest = float(value[column])
            if lowest == inf:
                break
            found.append((lowest, column))
            value[column] = inf  # one more argmin costs less than a sort
        else:
            self._end = found[-1] if len(found) < len(value) else _NONE
        for lowest, column in found:
            value[column] = lowest
