"""Failover benchmark: count of lost, repeated and skipped states."""

from __future__ import annotations

import pytest

from benchmarks.failover import Continuation


@pytest.mark.parametrize(
    ("said", "published", "first", "lost", "repeated", "skipped"),
    [
        (100, 100, 101, 0, 0, 0),
        (100, 99, 100, 0, 1, 0),  # power loss between the output and its state
        (100, 100, 100, 1, 1, 0),
        (100, 99, 98, 2, 3, 0),
        (100, 0, 99, 1, 2, 0),  # no state arrived, not even the one before the output
        (100, 100, 103, 0, 0, 2),
    ],
)
def test_a_published_state_without_a_continuation_is_lost(
    said, published, first, lost, repeated, skipped
):
    """By design a cycle with an output but without a published state is repeated."""
    found = Continuation(said, published, first)
    assert (found.lost, found.repeated, found.skipped) == (lost, repeated, skipped)
