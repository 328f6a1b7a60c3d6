"""What the failover benchmark counts as lost, as said again and as not heard."""

from __future__ import annotations

import pytest

from benchmarks.failover import GoneOn


@pytest.mark.parametrize(
    ("said", "published", "first", "lost", "repeated", "skipped"),
    [
        (100, 100, 101, 0, 0, 0),
        (100, 99, 100, 0, 1, 0),  # the power went between the output and its state
        (100, 100, 100, 1, 1, 0),
        (100, 99, 98, 2, 3, 0),
        (100, 0, 99, 1, 2, 0),  # of the states none was heard: that before the output was published
        (100, 100, 103, 0, 0, 2),
    ],
)
def test_a_state_is_lost_where_it_was_published_and_not_gone_on_from(
    said, published, first, lost, repeated, skipped
):
    """A cycle that had spoken and not published its state is said again by design."""
    gone_on = GoneOn(said, published, first)
    assert (gone_on.lost, gone_on.repeated, gone_on.skipped) == (lost, repeated, skipped)
