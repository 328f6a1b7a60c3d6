"""Times of the runs of a schedule: intervals, times of day, time zones and their changes."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.schedules import Schedule, is_zone, schedule_fault


def unix(text: str) -> float:
    """Return the unix time of a time in UTC."""
    return datetime.fromisoformat(text).replace(tzinfo=timezone.utc).timestamp()


def runs(schedule: Schedule, after: str, number: int) -> list[str]:
    """Return the next runs in UTC."""
    found, at = [], unix(after)
    for _ in range(number):
        at = schedule.next_run(at)
        found.append(f"{datetime.fromtimestamp(at, timezone.utc):%d %H:%M}")
    return found


@given(every=st.floats(1.0, 1e6), due=st.floats(1e9, 2e9), late=st.floats(0.0, 1e6))
def test_the_next_run_of_an_interval_is_ahead_and_at_most_one_interval(every, due, late) -> None:
    """However late the present one is."""
    schedule, wall = Schedule(every=every), due + late
    following = schedule.next_run(wall, due)
    assert wall < following <= wall + every * (1.0 + 1e-6) + 1e-6


def test_the_runs_of_an_interval_stay_in_step_with_the_first() -> None:
    """A late run does not shift the others."""
    assert Schedule(every=10.0).next_run(1034.0, 1000.0) == 1040.0
    assert Schedule(every=10.0).next_run(1000.0) == 1010.0


def test_the_next_time_of_day_is_today_or_tomorrow() -> None:
    """By the clock of its zone; the nearest of several times counts."""
    assert runs(Schedule(at=("02:00 UTC",)), "2026-11-26 01:59", 2) == ["26 02:00", "27 02:00"]
    assert runs(Schedule(at=("02:00 UTC",)), "2026-11-26 02:00", 1) == ["27 02:00"]
    two = Schedule(at=("02:00 Asia/Tokyo", "12:00 UTC"))
    assert runs(two, "2026-11-26 11:00", 3) == ["26 12:00", "26 17:00", "27 12:00"]


def test_days_are_those_of_the_zone() -> None:
    """Monday in Tokyo begins on Sunday in UTC."""
    monday = Schedule(at=("02:00 Asia/Tokyo",), on=("mon",))
    assert runs(monday, "2026-11-26 00:00", 2) == ["29 17:00", "06 17:00"]


def test_a_skipped_time_of_day_runs_when_the_clocks_are_set_forward() -> None:
    """On 29 March 2026 no clock in Berlin shows 02:30; 03:00 follows 01:59."""
    night = Schedule(at=("02:30 Europe/Berlin",))
    assert runs(night, "2026-03-27 12:00", 3) == ["28 01:30", "29 01:00", "30 00:30"]
    assert night.clock(unix("2026-03-29 01:00")) == "03:00 Europe/Berlin"


def test_a_repeated_time_of_day_runs_once() -> None:
    """On 25 October 2026 the clocks in Berlin show 02:30 twice."""
    night = Schedule(at=("02:30 Europe/Berlin",))
    assert runs(night, "2026-10-24 12:00", 2) == ["25 00:30", "26 01:30"]
    assert runs(night, "2026-10-25 00:45", 1) == ["26 01:30"]


@given(
    st.floats(0.0, 4e9), st.sampled_from(["00:00", "02:30", "23:59"]),
    st.sampled_from(["UTC", "Europe/Berlin", "America/New_York", "Pacific/Apia", "Asia/Tokyo"]),
)  # fmt: skip
def test_the_next_time_of_day_is_ahead_and_soon(wall, clock, zone) -> None:
    """In every zone, also over a change of its clocks."""
    schedule = Schedule(at=(f"{clock} {zone}",))
    assert wall < schedule.next_run(wall) <= wall + schedule.longest


def test_a_time_without_a_zone_gets_that_of_the_machine() -> None:
    """A zone that is given stays."""
    schedule = Schedule(at=("02:00", "03:00 UTC"))
    assert schedule.in_zone("Asia/Tokyo").at == ("02:00 Asia/Tokyo", "03:00 UTC")
    assert schedule_fault(schedule) == ""


def test_the_text_has_the_time_and_the_wait() -> None:
    """An interval has no time of day."""
    wall = unix("2026-11-26 21:00")
    at = Schedule(at=("02:00 UTC",))
    assert at.describe(at.next_run(wall), wall) == "02:00 UTC (in 5 h 0 min)"
    assert Schedule(every=600.0).describe(wall + 240.0, wall) == "in 4 min"
    assert Schedule(every=600.0).describe(wall, wall) == "now"


@pytest.mark.parametrize("name", ["", "Nowhere", "Etc", "/etc/localtime", "../UTC", "UTC/"])
def test_a_zone_that_the_machine_does_not_know_is_none(name) -> None:
    """A directory or a path is none either."""
    assert not is_zone(name)


def test_a_zone_that_was_lost_counts_as_utc() -> None:
    """A master that is moved to another machine continues."""
    assert runs(Schedule(at=("02:00 Nowhere/City",)), "2026-11-26 01:00", 1) == ["26 02:00"]
