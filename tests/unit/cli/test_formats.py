"""Formats of numbers in output."""

from __future__ import annotations

import pytest

from rosrm.cli.output import formats


@pytest.mark.parametrize(
    ("value", "binary", "text"),
    [(0, False, "0 B"), (999, False, "999 B"), (1000, False, "1.0 kB"), (64.06e6, False, "64.1 MB"),
     (2**31, False, "2.1 GB"), (999_999, False, "1.0 MB"), (123e9, False, "123 GB"),
     (1023, True, "1023 B"), (1024, True, "1.0 KiB"), (2**30, True, "1.0 GiB"),
     (850 * 2**20, True, "850 MiB")],
)  # fmt: skip
def test_sizes_have_three_digits(value, binary, text):
    assert formats.size(value, binary=binary) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (65, "65 s"), (3600, "60 min"), (7500, "2 h 5 min"),
     (200_000, "2 d"), (float("inf"), "?"), (-1, "0.0 s")],
)  # fmt: skip
def test_spans_have_at_most_two_units(value, text):
    assert formats.duration(value) == text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.5, "core", "0.5 cores"), (5e6, "B/s", "5.0 MB/s"), (3, "", "3"), (2, "lux", "2 lux"),
     (float("nan"), "B", "?")],
)  # fmt: skip
def test_amounts_carry_the_unit_of_their_resource(value, unit, text):
    assert formats.amount(value, unit) == text
