"""Messages without a valid key: counted for `rosrm status`, recorded at a bounded rate."""

from __future__ import annotations

import pytest

from rosrm.ros.master import strangers
from rosrm.ros.master.strangers import Strangers


class Clock:
    now = 1e6

    def boot_time(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(strangers, "clocks", clock)
    return clock


def test_messages_of_strangers_are_recorded_once_for_each_topic(clock) -> None:
    """Later ones are counted, and recorded with their number after ten minutes."""
    recorded: list[tuple[str, ...]] = []
    seen = Strangers(lambda *one: recorded.append(one))
    for _ in range(5000):
        seen.note("/rosrm/submit")
    seen.note("/rosrm/list")
    assert [who for _, who, _ in recorded] == [
        "a sender on /rosrm/submit", "a sender on /rosrm/list",
    ]  # fmt: skip
    clock.now += 600.0
    seen.note("/rosrm/submit")
    assert "5000 messages without a valid key" in recorded[-1][2]


def test_the_messages_that_a_slave_reports_are_added(clock) -> None:
    """Its host is named in place of a topic."""
    recorded: list[tuple[str, ...]] = []
    seen = Strangers(lambda *one: recorded.append(one))
    seen.note("/rosrm/submit")
    seen.note("the topics of host:robot-1", 40)
    assert recorded[-1][2].startswith("40 messages without a valid key on the topics of host:robot")
    assert seen.sentence().startswith("41 messages without a valid key refused, the last")


def test_the_status_has_the_newest_of_the_last_hour(clock) -> None:
    seen = Strangers(lambda *_: None)
    assert seen.sentence() == ""
    seen.note("/rosrm/submit")
    clock.now += 60.0
    seen.note("/rosrm/list")
    clock.now += 2.0
    assert (
        seen.sentence()
        == "2 messages without a valid key refused, the last 2.0 s ago on /rosrm/list"
    )
    clock.now += 3600.0
    assert seen.sentence() == ""
