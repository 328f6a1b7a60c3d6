"""Shortlist of the lowest values: equal to a search of all values, after any changes."""

from __future__ import annotations

from math import inf

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master.scheduling.shortlist import WANTED, Shortlist

values = st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0, 2.0, inf])
changes = st.dictionaries(st.integers(0, 39), values, max_size=40)
wanted_columns = st.integers(0, WANTED)  # 0: no search before the next change


@given(st.lists(values, max_size=40), st.lists(st.tuples(changes, wanted_columns), max_size=30))
def test_a_shortlist_has_the_lowest_values_after_every_change(
    start: list[float], changed: list[tuple[dict[int, float], int]]
) -> None:
    """Columns with the lowest finite values, and their number, are those of a new search."""
    array = np.array(start, np.float64)
    kept = Shortlist(array)
    for values_at, wanted in changed:
        at = {column: value for column, value in values_at.items() if column < len(array)}
        kept.put(list(at), list(at.values()))
        finite = [int(column) for column in np.flatnonzero(array < inf)]
        ordered = sorted(finite, key=lambda one: (array[one], one))
        assert kept.lowest(wanted) == ordered[:wanted]
        if wanted:
            assert kept.finite() == len(finite)
        for column, value in at.items():
            assert array[column] == value
