"""Figures of the master's load, as clients read them."""

from __future__ import annotations

import math

from rosrm.ros.load_reader import figures


def test_the_oldest_reading_is_one_number():
    """The message has an age for each check of the readings."""
    assert figures({"turn_s": 0.02, "oldest_reading_s": [0.1, 0.4, 0.2]}) == {
        "turn_s": 0.02, "oldest_reading_s": 0.4,
    }  # fmt: skip


def test_what_is_no_number_is_left_out():
    """A master of another version may have other figures."""
    strange = {"turn_s": "1", "write_s": math.nan, "cpu_s": None, "oldest_reading_s": [math.inf]}

    assert figures(strange) == {"oldest_reading_s": 0.0}
