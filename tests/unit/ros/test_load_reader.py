"""Figures of the master's load, as clients read them."""

from __future__ import annotations

import math
from types import SimpleNamespace

from rosrm.ros.load_reader import LoadReader, figures


def test_the_oldest_reading_is_one_number():
    """The message has an age for each check of the readings."""
    assert figures({"turn_s": 0.02, "oldest_reading_s": [0.1, 0.4, 0.2]}) == {
        "turn_s": 0.02, "oldest_reading_s": 0.4,
    }  # fmt: skip


def test_what_is_no_number_is_left_out():
    """A master of another version may have other figures."""
    strange = {"turn_s": "1", "write_s": math.nan, "cpu_s": None, "oldest_reading_s": [math.inf]}

    assert figures(strange) == {"oldest_reading_s": 0.0}


class Endpoints:
    """Endpoints that note subscriptions."""

    def __init__(self):
        self.takers, self.destroyed = [], []
        self.participant = SimpleNamespace(
            node=SimpleNamespace(destroy_subscription=self.destroyed.append)
        )

    def follow(self, _kind, _topic, _profile, take):
        self.takers.append(take)
        return len(self.takers)


def test_old_figures_are_no_figures_and_a_silent_subscription_is_replaced():
    """A subscription that was made without free descriptors may never receive."""
    now, endpoints = [100.0], Endpoints()
    reader = LoadReader(endpoints, "load", lambda: now[0])
    endpoints.takers[0](SimpleNamespace(data='{"hosts": 3}'), b"")
    assert reader.newest()["hosts"] == 3
    now[0] += 6.0
    assert reader.newest() == {}
    assert endpoints.destroyed == []
    now[0] += 10.0
    assert reader.newest() == {}
    assert endpoints.destroyed == [1]
    endpoints.takers[1](SimpleNamespace(data='{"hosts": 4}'), b"")
    assert reader.newest()["hosts"] == 4
