"""Shortlist of the lowest values: equal to a search of all values, after any changes."""

from __future__ import annotations

from math import inf

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master.scheduling.shortlist import WANTED, Shortlist

values = st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0, 2.0, inf])
changes = st.lists(st.dictionaries(st.integers(0, 39), values, max_size=40), max_size=30)


@given(st.lists(values, max_size=40), changes, st.booleans())
def test_a_shortlist_has_the_lowest_values_after_every_change(
    start: list[float], changed: list[dict[int, float]], searched: bool
) -> None:
    """Columns with the lowest finite values, and their number, are those of a new search."""
    array = np.array(start, np.float64)
    kept = Shortlist(array)
    for values_at in ({}, *changed):
        at = {column: value for column, value in values_at.items() if column < len(array)}
        kept.put(list(at), list(at.values()))
        finite = [int(column) for column in np.flatnonzero(array < inf)]
        if searched or len(values_at) % 2:  # a change may follow one without a search
            assert kept.lowest() == sorted(finite, key=lambda one: (array[one], one))[:WANTED]
            assert kept.finite() == len(finite)
        for column, value in at.items():
            assert array[column] == value
