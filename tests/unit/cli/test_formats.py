"""Formats of numbers in output."""

from __future__ import annotations

import pytest

from rosrm.cli.output import formats


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (64.06e6, "64.1 MB"), (2**31, "2.1 GB"),
     (999_999, "1.0 MB"), (123e9, "123 GB")],
)  # fmt: skip
def test_sizes_have_three_digits(value, text):
    assert formats.size(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(1023, "1023 B"), (1024, "1.0 KiB"), (2**30, "1.0 GiB"), (850 * 2**20, "850 MiB")],
)
def test_sizes_in_powers_of_1024(value, text):
    assert formats.size(value, binary=True) == text


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
