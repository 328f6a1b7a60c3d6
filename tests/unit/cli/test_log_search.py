"""`rosrm logs`: levels and times in lines, search, JSON, and times in options."""

from __future__ import annotations

import json
import time
from datetime import datetime, timezone

import pytest

from rosrm.cli.log_copies import time_of
from rosrm.cli.output import log_lines
from rosrm.cli.output.log_levels import Level, level_of, stamp_of
from rosrm.cli.output.log_lines import LogStream
from rosrm.cli.output.log_search import LineSearch, pattern_of
from rosrm.client.logs import LogChunk
from rosrm.errors import ConfigError

from .conftest import process
from .test_logs import NOON, slaves  # noqa: F401 - a fixture

ROS = "[{}] [1700000000.123456789] [nav.planner]: text"


@pytest.mark.parametrize(
    ("line", "level"),
    [
        *((ROS.format(level.name), level) for level in Level),
        (f"\x1b[33m{ROS.format('WARN')}\x1b[0m", Level.WARN),
        ("[nav-3] [INFO] [1700000000.1] [nav]: launched", Level.INFO),
        ("[1700000000.1] [ERROR] [nav]: another order", Level.ERROR),
        ("WARNING:root:of Python", Level.WARN),
        ("CRITICAL:root:of Python", Level.FATAL),
        ("2026-11-27 09:30:00,123 ERROR nav: text", Level.ERROR),
        ("2026-11-27 09:30:00,123 - nav.planner - DEBUG - text", Level.DEBUG),
        ("2026-11-27T09:30:00Z [INFO] text", Level.INFO),
        ("no ERROR here: [ERROR] is in the text", None),
        ("ERRORS: 3", None),
        ("[" * 10_000 + "] " * 10_000, None),
        ("", None),
    ],
)
def test_the_level_of_a_line_is_recognised(line, level):
    assert level_of(line) == level


def test_the_time_in_a_line_of_a_node_is_recognised():
    assert stamp_of(ROS.format("INFO")) == pytest.approx(1700000000.123456789)
    assert stamp_of("[INFO] [12.5] [nav]: simulated time is no unix time") == 0.0
    assert stamp_of("WARNING:root:1700000000.1") == 0.0


def lines_of(search, text, marks=(), **options):
    stream = LogStream("nav", search=search, **options)
    stream.write(LogChunk("nav", "alpha", 3, text, 0, 0, True, marks))
    stream.close()
    return stream.take()


TRACEBACK = (
    b"[INFO] [1700000000.1] [nav]: fine\n"
    b"[ERROR] [1700000000.2] [nav]: failed\nTraceback:\n  ValueError\n"
    b"[WARN] [1700000000.3] [nav]: slow\n"
)


def test_a_line_without_a_level_or_time_has_those_of_the_line_before():
    """So a traceback stays beside its error among the lines of other processes."""
    found = lines_of(LineSearch(level=Level.ERROR), TRACEBACK, [(NOON + 0.5, len(TRACEBACK), 0)])
    assert [line for _, line in found] == [
        b"[ERROR] [1700000000.2] [nav]: failed\n", b"Traceback:\n", b"  ValueError\n",
    ]  # fmt: skip
    assert [time for time, _ in found] == pytest.approx([NOON + 0.2] * 3)


def test_a_time_far_from_that_of_the_supervisor_is_not_used():
    """A node may print any number; the supervisor's time is right to within a second."""
    text = b"[INFO] [1700000000.1] [nav]: text\n"
    ((found, _),) = lines_of(LineSearch(until=9e9), text, [(NOON + 3600.0, len(text), 0)])
    assert found == NOON + 3600.0


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1.0, 1e300])
def test_impossible_times_count_as_unknown(time):
    """Times come from other hosts, which may send any number."""
    stream = LogStream("nav", timestamps=True)
    stream.write(LogChunk("nav", "alpha", 3, b"one\n", 0, 0, True, [(time, 0, 77), (time, 4, 0)]))
    assert [text for _, text in stream.take()] == [b"? one\n"]


def test_another_program_begins_without_a_level():
    text = b"[ERROR] [1700000000.2] [nav]: failed\nplain\n"
    marks = [(NOON, 37, 77), (NOON, len(text), 0)]
    found = lines_of(LineSearch(level=Level.DEBUG), text, marks)
    assert [line for _, line in found] == [b"[ERROR] [1700000000.2] [nav]: failed\n"]


def test_until_leaves_out_later_lines():
    text = b"[INFO] [1700000000.1] [nav]: a\n[INFO] [1700000000.3] [nav]: b\n"
    found = lines_of(LineSearch(until=NOON + 0.2), text, [(NOON + 1.0, len(text), 0)])
    assert [line[-2:] for _, line in found] == [b"a\n"]


def test_until_leaves_out_later_starts():
    stream = LogStream("nav", search=LineSearch(until=NOON))
    stream.write(LogChunk("nav", "alpha", 3, b"a\n", 0, 0, True, [(NOON - 1.0, 2, 0)]))
    late = [(NOON + 1.0, 0, 77), (NOON + 1.0, 2, 0)]
    stream.write(LogChunk("nav", "alpha", 4, b"b\n", 0, 0, True, late))
    assert [line for _, line in stream.take()] == [b"a\n"]


def test_an_ambiguous_expression_is_taken_without_a_warning(recwarn):
    """Otherwise Python would print a warning with the path of one of its modules."""
    assert pattern_of("--grep", "[[nav]").search("[nav]: text")
    assert not recwarn.list


def test_a_line_is_an_object_of_json():
    """Invalid bytes and control characters cannot break the form."""
    text = b"[WARN] [1700000000.2] [nav]: \xff\x1b[2J\r\nrest"
    found = lines_of(LineSearch(as_json=True), text, [(NOON + 0.5, len(text), 0)])
    forms = [json.loads(line) for _, line in found]
    assert forms[0] == {
        "time": 1700000000.2, "process": "nav", "host": "alpha", "instance": 3, "level": "WARN",
        "line": "[WARN] [1700000000.2] [nav]: \ufffd\x1b[2J",
    }  # fmt: skip
    assert [form["line"] for form in forms[1:]] == ["rest"]


def test_lines_have_the_colour_of_their_level():
    """A program cannot print control characters with it."""
    found = lines_of(LineSearch(coloured=True), TRACEBACK + b"\x1b[2J\n", raw=False)
    assert found[0][1] == b"[INFO] [1700000000.1] [nav]: fine\n"
    assert found[1][1] == b"\x1b[31m[ERROR] [1700000000.2] [nav]: failed\x1b[0m\n"
    assert found[-1][1] == b"\x1b[33m\\x1b[2J\x1b[0m\n"


def test_an_endless_line_is_divided(monkeypatch):
    """Output without line ends would otherwise stay in memory."""
    monkeypatch.setattr(log_lines, "_LONGEST_LINE", 4)
    stream = LogStream("nav", search=LineSearch(pattern=pattern_of("--grep", "a")))
    for at in range(4):
        stream.write(LogChunk("nav", "alpha", 3, b"aaa", 3 * at, 0, at == 0, ()))
    assert b"".join(line for _, line in stream.take()) == b"aaaaaa\naaaaaa\n"


def test_a_search_shows_only_its_lines(rosrm, slaves):  # noqa: F811
    """The lines of rosrm are not among them."""
    slaves.write("alpha", 1, TRACEBACK, at=NOON + 1.0)
    slaves.start("alpha", 1, at=NOON + 2.0)
    assert rosrm("logs", "talker", "--grep", r"slow|\[INFO\]").out.splitlines() == [
        "[INFO] [1700000000.1] [nav]: fine", "[WARN] [1700000000.3] [nav]: slow",
    ]  # fmt: skip
    assert len(rosrm("logs", "talker", "--level", "warning").out.splitlines()) == 4
    assert "slow" not in rosrm("logs", "talker", "--until", "2023-11-14T22:13:20.2Z").out
    (form,) = map(json.loads, rosrm("logs", "talker", "--json", "--grep", "slow$").out.splitlines())
    assert (form["level"], form["instance"], form["host"]) == ("WARN", 1, "alpha")


def test_the_processes_of_an_application_are_searched(rosrm, client, slaves):  # noqa: F811
    client.processes = [
        process("talker", application="nav"), process("ear", application="nav"), process("other"),
    ]  # fmt: skip
    slaves.write("alpha", 1, b"[ERROR] [1700000000.2] [a]: x\n", at=NOON + 0.5)
    slaves.write("alpha", 2, b"[ERROR] [1700000000.1] [b]: y\n", "ear", at=NOON + 0.5)
    slaves.write("alpha", 3, b"ERROR:z\n", "other", at=NOON)
    assert rosrm("logs", "--app", "nav", "--grep", "ERROR").out.splitlines() == [
        "ear    | [ERROR] [1700000000.1] [b]: y", "talker | [ERROR] [1700000000.2] [a]: x",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["talker", "--grep", "(a"], "--grep (a: this is no regular expression"),
        (["talker", "--level", "loud"], "a level is debug, info, warn, error or fatal"),
        (["talker", "--since", "noon"], "e.g. 10min, or a time, e.g. 2026-11-27T09:30"),
        (["talker", "--until", "2026-13-01"], "--until: "),
        (["talker", "--until", "1h", "-f"], "-f prints output without an end"),
        (["talker", "--app", "nav"], "give the names of processes, or an application"),
        ([], "give the names of processes, or an application"),
    ],
)
def test_a_wrong_option_is_refused(rosrm, slaves, options, message):  # noqa: F811
    result = rosrm("logs", *options)
    assert (result.code, result.out, message in result.err) == (2, "", True)


def test_a_time_is_a_span_or_a_date():
    """A date without a time zone is local time."""
    utc = datetime(2026, 11, 27, 9, 30, tzinfo=timezone.utc)
    assert time_of("--since", "2026-11-27T09:30Z") == utc.timestamp()
    assert time_of("--since", "2026-11-27 10:30+01:00") == utc.timestamp()
    assert time_of("--since", "2026-11-27") == datetime(2026, 11, 27).timestamp()  # noqa: DTZ001
    assert time_of("--since", "2h") == pytest.approx(time.time() - 7200, abs=60)
    assert time_of("--since", "") == 0.0
    with pytest.raises(ConfigError, match="longer than ten years"):
        time_of("--since", "99999999h")
