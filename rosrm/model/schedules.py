"""Schedules of jobs: the unix times of their runs, as functions of a given time.

Nothing here reads a clock. The rules of the time zones are those of the machine (`zoneinfo`).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, replace
from datetime import date, datetime, time, timedelta, timezone, tzinfo
from io import BytesIO
from math import floor
from typing import Final

from rosrm.model.durations import LONGEST
from rosrm.wording import duration, get_close_matches, listed

#: Shortest time between two runs, in seconds.
SHORTEST: Final = 1.0
#: Most times of day in one schedule.
MOST_TIMES: Final = 256
WEEKDAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
#: Forms of a time of day, in messages.
_EXAMPLES: Final = '"02:00" or "02:00 Europe/Berlin"'
_TIME: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)(?: +([A-Za-z0-9_+/<>.,:-]{1,64}))?")
#: Rules of a zone as in the variable TZ: "CET-1CEST,M3.5.0,M10.5.0/3", "<+0330>-3:30".
_ABBREVIATION: Final = r"(?:<[A-Za-z0-9+-]{3,}>|[A-Za-z]{3,})"
_OFFSET: Final = r"[+-]?\d{1,3}(?::\d\d){0,2}"
_RULES: Final = re.compile(
    rf"{_ABBREVIATION}{_OFFSET}(?P<summer>{_ABBREVIATION}(?:{_OFFSET})?(?P<changes>,.+,.+)?)?"
)
#: Changes of a zone with summer time whose rules name none, as in the C library.
_USUAL_CHANGES: Final = ",M3.2.0,M11.1.0"
#: Days that are searched for the next run: a week, and a day more on each side for the zone.
_DAYS: Final = range(-1, 9)
_DAY: Final = 86400.0


@dataclass(frozen=True, slots=True)
class Schedule:
    """Times at which a job starts again.

    Attributes:
        every: seconds from one start to the next; 0: none.
        at: times of day, each with its time zone: "02:00 Europe/Berlin"; without a zone only until
            the master has accepted the job.
        on: days of `at`, in its time zone: "mon"; (): every day.
    """

    every: float = 0.0
    at: tuple[str, ...] = ()
    on: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Return True if the job starts again without a request."""
        return bool(self.every or self.at)

    @property
    def longest(self) -> float:
        """Return an upper bound of the seconds from one run to the next."""
        if self.every:
            return self.every
        return 9 * _DAY if self.on else 3 * _DAY  # a zone may skip a whole day

    def in_zone(self, zone: str) -> Schedule:
        """Return the schedule with this time zone for each time of day without one."""
        if all(" " in one for one in self.at):
            return self
        return replace(self, at=tuple(one if " " in one else f"{one} {zone}" for one in self.at))

    def next_run(self, wall: float, due: float = 0.0) -> float:
        """Return the unix time of the first run after `wall`.

        Args:
            wall: unix time.
            due: unix time of any other run; 0: `wall` is a run itself.
        """
        if self.every:
            return wall + self.every if not due else self._after(wall, due)
        return min(_next_at(wall, one, self.on) for one in self.at)

    def _after(self, wall: float, due: float) -> float:
        following = due + self.every * (floor((wall - due) / self.every) + 1)
        return following if following > wall else following + self.every

    def describe(self, run: float, wall: float) -> str:
        """Return a time of day with its zone and the rest of time: "02:00 UTC (in 5 h)"."""
        rest = f"in {duration(run - wall)}" if run > wall else "now"
        return f"{self.clock(run)} ({rest})" if self.at else rest

    def clock(self, run: float) -> str:
        """Return the time of a run: "02:00 UTC"; for an interval in UTC, with seconds."""
        if not self.at:
            return f"{datetime.fromtimestamp(run, timezone.utc):%H:%M:%S} UTC"
        name = self.at[0].partition(" ")[2].strip()
        return f"{datetime.fromtimestamp(run, _zone_or_utc(name)):%H:%M} {name}"


NO_SCHEDULE: Final = Schedule()


def schedule_fault(schedule: Schedule) -> str:
    """Return why a schedule is refused, with the key at the beginning; "": it is valid."""
    if schedule.every and schedule.at:
        return "every: an interval and times of day (`at`) exclude each other; give one of them"
    if schedule.every and not SHORTEST <= schedule.every <= LONGEST:
        return f"every: {schedule.every:g} s; allowed: {SHORTEST:g} s to ten years"
    if schedule.on and not schedule.at:
        return "on: only times of day (`at`) have days"
    unknown = [day for day in schedule.on if day not in WEEKDAYS]
    if unknown:
        return f"on: {unknown[0]!r:.20} is no day; allowed: {', '.join(WEEKDAYS)}"
    if len(schedule.at) > MOST_TIMES or len(schedule.on) > len(WEEKDAYS):
        return f"at: at most {MOST_TIMES} times and {len(WEEKDAYS)} days"
    faults = (_time_fault(one) for one in schedule.at)
    return next((f"at: {fault}" for fault in faults if fault), "")


def is_zone(name: str) -> bool:
    """Return True if this machine knows a time zone."""
    try:
        _zone(name)
    except ValueError:
        return False
    return True


def _time_fault(text: str) -> str:
    found = _TIME.fullmatch(text)
    if found is None:
        return f"{text!r:.100} is no time of day; for example {_EXAMPLES}"
    if found[3] is None or is_zone(found[3]):
        return ""
    return f"unknown time zone {found[3]!r}{_near_zones(found[3])}"


def _near_zones(name: str) -> str:
    from zoneinfo import available_timezones  # noqa: PLC0415 - only jobs with a schedule need it

    known = available_timezones()
    if not known:
        return "; this machine knows only UTC: install the package tzdata"
    near = get_close_matches(name, sorted(known))
    return f"; did you mean {listed(near, 'or')}?" if near else "; for example Europe/Berlin, UTC"


def _zone(name: str) -> tzinfo:
    """Return a time zone; UTC needs no database of zones.

    Raises:
        ValueError: the machine does not know the zone.
    """
    from zoneinfo import ZoneInfo  # noqa: PLC0415 - only jobs with a schedule need it

    if name == "UTC":
        return timezone.utc
    try:
        return ZoneInfo(name)
    except (KeyError, OSError, ValueError):  # a directory of the database is an OSError
        return _by_rules(name)


def _by_rules(text: str) -> tzinfo:
    """Return the time zone with the rules of a text as in TZ; raises `ValueError`."""
    from zoneinfo import ZoneInfo  # noqa: PLC0415 - only jobs with a schedule need it

    found = _RULES.fullmatch(text)
    if found is None:
        raise ValueError(f"unknown time zone {text!r}")
    rules = text + _USUAL_CHANGES if found["summer"] and not found["changes"] else text
    # A file of the database without any past change, whose last line has the rules.
    block = b"TZif2" + bytes(15) + struct.pack(">6L", 0, 0, 0, 0, 1, 4) + bytes(6) + b"UTC\0"
    return ZoneInfo.from_file(BytesIO(2 * block + f"\n{rules}\n".encode()), key=text)


def _zone_or_utc(name: str) -> tzinfo:
    """Return a time zone; UTC if the machine has lost the zone since the job was accepted."""
    return _zone(name) if is_zone(name) else timezone.utc


def _next_at(wall: float, text: str, on: tuple[str, ...]) -> float:
    """Return the first unix time after `wall` with a time of day: "02:00 Europe/Berlin"."""
    clock, _, name = text.partition(" ")
    zone = _zone_or_utc(name.strip())
    today = datetime.fromtimestamp(wall, zone).date()
    days = (today + timedelta(days=number) for number in _DAYS)
    runs = (_run_on(day, clock, zone) for day in days if not on or WEEKDAYS[day.weekday()] in on)
    return next(run for run in runs if run > wall)


def _run_on(day: date, clock: str, zone: tzinfo) -> float:
    """Return the unix time of a time of day.

    If the clocks are set back over it, the first of the two; if they are set forward over it, the
    moment of that change.
    """
    hours, minutes = map(int, clock.split(":"))
    wanted = datetime.combine(day, time(hours, minutes), zone)
    run = wanted.timestamp()
    if datetime.fromtimestamp(run, zone).replace(tzinfo=None) == wanted.replace(tzinfo=None):
        return run
    return _change_between(wanted.replace(fold=1).timestamp(), run, zone)


def _change_between(before: float, after: float, zone: tzinfo) -> float:
    """Return the unix time in whole seconds at which the offset of a zone changes."""

    def offset(at: float) -> object:
        return datetime.fromtimestamp(at, zone).utcoffset()

    first = offset(before)
    while after - before > 1.0:
        middle = float(floor((before + after) / 2))
        before, after = (middle, after) if offset(middle) == first else (before, middle)
    return after
