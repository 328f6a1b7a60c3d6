"""Results are found by the identity of their argument."""

from __future__ import annotations

from rosrm.model.remembered import remembered


def test_a_result_is_that_of_this_very_object() -> None:
    """Equal objects have results of their own, also when many were remembered in between."""
    calls: list[list[int]] = []

    def length(numbers: list[int]) -> int:
        calls.append(numbers)
        return len(numbers)

    known = remembered(length)
    first = [1]
    assert [known(first), known(first)] == [1, 1]
    assert len(calls) == 1
    # Each of these lists is gone at once, so that its memory is used again.
    assert [known([0] * size) for size in range(1000)] == list(range(1000))
    assert known(first) == 1


def test_a_large_result_is_not_kept() -> None:
    """Otherwise a sender could fill the memory."""
    calls: list[str] = []
    known = remembered(lambda text: (calls.append(text), text * 2)[1], lambda two: len(two) < 4)
    small, large = "a", "abc"
    for text in (small, small, large, large):
        assert known(text) == text * 2
    assert calls == [small, large, large]
