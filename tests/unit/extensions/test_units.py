"""Quantities: numbers in base units, or text with a unit."""

from __future__ import annotations

import re

import pytest

from rosrm.extensions.units import Quantity, amount_of

SIZE, DURATION, NUMBER = Quantity("size", whole=True), Quantity("duration"), Quantity()


@pytest.mark.parametrize(
    ("marker", "given", "value"),
    [
        (SIZE, 1024, 1024),
        (SIZE, "2GiB", 2 * 2**30),
        (SIZE, "500MB", 500_000_000),
        (SIZE, "64 MiB", 64 * 2**20),
        (SIZE, "1.5 kB", 1500),
        (SIZE, "7", 7),
        (DURATION, "500ms", 0.5),
        (DURATION, "10s", 10.0),
        (DURATION, "2min", 120.0),
        (DURATION, "1h", 3600.0),
        (DURATION, 3, 3.0),
        (NUMBER, "0.5", 0.5),
        (NUMBER, "1e-3", 0.001),
    ],
)
def test_a_quantity_is_read_in_base_units(marker, given, value):
    assert marker.parse(given) == pytest.approx(value)


@pytest.mark.parametrize(
    ("marker", "given", "said"),
    [
        (SIZE, "2gib", "did you mean 'GiB'?"),
        (SIZE, "2 apples", "Allowed: B, kB"),
        (SIZE, "1.0005kB", "not a whole number"),
        (SIZE, "big", "is not a number, or text such as"),
        (DURATION, "10 sec", "unknown unit 'sec'"),
        (DURATION, -1, "is not at least 0"),
        (DURATION, "-1s", "is not at least 0"),
        (DURATION, True, "is not a number"),
        (DURATION, None, "is not a number"),
        (DURATION, float("nan"), "is not at least 0"),
        (DURATION, float("inf"), "is not at least 0"),
        (DURATION, "88000h", "is longer than ten years"),
        pytest.param(DURATION, 10**400, "is not at least 0", id="huge"),
        (NUMBER, "5s", "a number without a unit is required"),
        (Quantity(high=1.0), 1.01, "is not within 0..1"),
        (Quantity(high=2**31 - 1, whole=True), -1, "is not within 0..2147483647"),
        (Quantity(above=True), 0, "is not greater than 0"),
        (Quantity(whole=True), 1.5, "not a whole number"),
    ],
)
def test_what_is_no_such_quantity_is_refused_with_what_is_allowed(marker, given, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        marker.parse(given)


def test_an_amount_takes_the_units_of_its_resource_only():
    amounts = {("memory", "8MB"): 8e6, ("cpu", "0.5 cores"): 0.5, ("network", "10 MB/s"): 10e6}
    assert {given: amount_of(*given) for given in amounts} == amounts
    for resource, given, unit in (("cpu", "8MB", "MB"), ("memory", "2 cores", "cores")):
        with pytest.raises(ValueError, match=f"unknown unit '{unit}'"):
            amount_of(resource, given)
