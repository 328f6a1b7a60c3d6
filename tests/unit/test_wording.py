"""Numbers and times in messages."""

from __future__ import annotations

import pytest

from rosrm.wording import counted, standing_for


@pytest.mark.parametrize(("number", "text"), [(0, "no hosts"), (1, "1 host"), (2, "2 hosts")])
def test_a_number_with_its_noun(number: int, text: str) -> None:
    """A count of zero reads "no"."""
    assert counted(number, "host") == text


@pytest.mark.parametrize(
    ("state", "text"),
    [
        ("unreachable", "has been unreachable for 2 min"),
        ("backoff", "has been in back-off for 2 min"),
        ("finished", "finished 2 min ago"),
        ("cancelled", "was cancelled 2 min ago"),
    ],
)
def test_a_state_with_its_time(state: str, text: str) -> None:
    """A terminal state has an end, any other state a duration."""
    assert standing_for(state, "2 min") == text
