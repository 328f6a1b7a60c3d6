"""Numbers and times in messages."""

from __future__ import annotations

import pytest

from rosrm.wording import (
    amount,
    counted,
    duration,
    ending_of,
    sanitized,
    size,
    standing_for,
    with_article,
)


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


@pytest.mark.parametrize(
    ("value", "binary", "text"),
    [(0, False, "0 B"), (999, False, "999 B"), (1000, False, "1.0 kB"), (64.06e6, False, "64.1 MB"),
     (2**31, False, "2.1 GB"), (999_999, False, "1.0 MB"), (123e9, False, "123 GB"),
     (1023, True, "1023 B"), (1024, True, "1.0 KiB"), (2**30, True, "1.0 GiB"),
     (850 * 2**20, True, "850 MiB")],
)  # fmt: skip
def test_sizes_have_three_digits(value, binary, text):
    assert size(value, binary=binary) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (65, "65 s"), (3600, "60 min"), (7500, "2 h 5 min"),
     (200_000, "2 d"), (float("inf"), "?"), (-1, "0.0 s")],
)  # fmt: skip
def test_spans_have_at_most_two_units(value, text):
    assert duration(value) == text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.5, "core", "0.5 cores"), (5e6, "B/s", "5.0 MB/s"), (3, "", "3"), (2, "lux", "2 lux"),
     (float("nan"), "B", "?"), (8.31e-05, "core", "under 0.001 cores"), (0.0, "core", "0 cores")],
)  # fmt: skip
def test_amounts_carry_the_unit_of_their_resource(value, unit, text):
    assert amount(value, unit) == text


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("plain, with ü and …", "plain, with ü and …"),
        ("\x1b[31mred\x07", "?[31mred?"),
        ("\x9b2J of C1", "?2J of C1"),
        ("two\nlines\tand a tab", "two lines and a tab"),
        ("a reversed \u202e name", "a reversed ? name"),
        (30 * "x", 19 * "x" + "…"),
    ],
)
def test_a_text_of_any_sender_has_nothing_that_a_terminal_executes(given: str, text: str) -> None:
    """Control characters are replaced, and the length is bounded."""
    assert sanitized(given, 20 if len(given) == 30 else 100) == text


def test_a_noun_has_its_article() -> None:
    """Refusals of names are sentences."""
    assert with_article("host") == "a host"
    assert with_article("application") == "an application"


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0, "exit code 0"), (3, "exit code 3"), (-15, "killed by SIGTERM"),
        (-35, "killed by signal 35"), (-400, "killed by signal 400"),
    ],
)  # fmt: skip
def test_each_return_code_has_a_phrase(code, text):
    """A signal without a name, as a real-time signal, is shown by its number."""
    assert ending_of(code) == text
