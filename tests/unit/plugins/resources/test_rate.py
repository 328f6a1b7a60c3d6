"""Rate of a counter over a sliding window."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm_resources.rate import Rate


def test_steady_counter():
    """A counter that grows evenly has that rate from the second count on."""
    rate = Rate(1.0, at=10.0, count=5.0)
    for step in range(1, 30):
        assert rate.update(10.0 + step * 0.1, 5.0 + step * 0.1 * 3.0) == pytest.approx(3.0)


def test_forgets_what_is_older_than_its_window():
    """A burst is gone from the rate once the window has passed."""
    rate = Rate(1.0, at=0.0, count=0.0)
    assert rate.update(0.1, 10.0) == pytest.approx(100.0)
    for step in range(2, 12):
        last = rate.update(step * 0.1, 10.0)
    assert last == pytest.approx(0.0)


def test_too_short_a_time_repeats_the_last_rate():
    """Two counts within a clock tick of the kernel give no rate."""
    rate = Rate(1.0, at=0.0, count=0.0, guess=0.7)
    assert rate.update(0.001, 1.0) == 0.7


def test_fallen_counter_begins_anew():
    """A counter that was reset gives no negative rate."""
    rate = Rate(1.0, at=0.0, count=100.0)
    assert rate.update(0.5, 150.0) == pytest.approx(100.0)
    assert rate.update(1.0, 0.0) == pytest.approx(100.0)
    assert rate.update(1.5, 10.0) == pytest.approx(20.0)


def test_nonsense_raises():
    """A NaN count is refused."""
    with pytest.raises(ValueError, match="nan"):
        Rate(1.0, 0.0, 0.0).update(1.0, float("nan"))


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0, 1e6)), max_size=60))
def test_never_negative_nor_above_the_fastest(steps):
    """For any counter and any reading times, the rate stays between 0 and the fastest step."""
    rate, at, count, fastest = Rate(1.0, 0.0, 0.0), 0.0, 0.0, 0.0
    begun = 0.0
    for seconds, grown in steps:
        at, count = at + seconds, count + grown
        fastest = max(fastest, count / 0.02)
        begun = rate.update(at, count)
        assert 0.0 <= begun <= fastest
