"""`rosrm logs`: search of the slaves that hold the logs, copy and follow.

The slaves are folders here, read by the slave's own reader.
"""

from __future__ import annotations

import re
import time
from datetime import datetime
from io import StringIO

import pytest

from rosrm import Client
from rosrm.cli import log_copies
from rosrm.errors import NoMaster, Refused
from rosrm.model.values import InstanceId
from rosrm.ros.slave.services import LogQuery
from rosrm.slave.logs import newest_instance, read_log
from rosrm.supervisor import log_index
from rosrm.supervisor.client import log_path
from rosrm.supervisor.log_index import Mark
from rosrm.supervisor.logs import LogLimits, rotate

from .conftest import event, host, process

NOON = 1_700_000_000.0


class Slaves:
    """Logs of instances below a folder; `live` has the instances that have not ended."""

    def __init__(self, folder):
        self.folder, self.live = folder, set()

    def path(self, on, number, name="talker"):
        path = log_path(self.folder / on, InstanceId(name, number))
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def start(self, on, number, name="talker", *, at=NOON):
        """Start a program without output."""
        path = self.path(on, number, name)
        path.touch()
        log_index.add(str(path), Mark(at, self.end(path), 77))

    def write(self, on, number, content, name="talker", *, at=NOON):
        """Write output of a program, and let the supervisor look."""
        path = self.path(on, number, name)
        if not path.exists():
            self.start(on, number, name, at=at)
        with path.open("ab") as log:
            log.write(content)
        log_index.add(str(path), Mark(at, self.end(path), 0))

    def end(self, path):
        return (log_index.base(str(path)) or 0) + path.stat().st_size

    def rotate(self, on, number, name="talker", *, most=1 << 20, keep=2):
        path = self.path(on, number, name)
        rotate(str(path), path.stat().st_size, LogLimits(most, keep))

    def read(self, on, name, number=0, offset=0, max_bytes=0, *, tail=0, since=0.0):
        state = self.folder / on
        number = number or newest_instance(state, name).number
        ended = (on, number) not in self.live
        return read_log(state, LogQuery(name, number, offset, tail, since, max_bytes), ended=ended)


@pytest.fixture
def slaves(client, tmp_path):
    """Provide logs by host and instance; the client reads from them."""
    made = Slaves(tmp_path)
    client.hosts = [host("alpha"), host("beta")]

    def read(on, *query, **more):
        client.asked.append(("read_log", on))
        return made.read(on, *query, **more)

    client.read_log = read
    client.events = []
    return made


@pytest.fixture
def lines(rosrm):
    """Return a function that gives the lines of `rosrm logs`, without those before a start."""

    def lines(*words):
        out = rosrm("logs", *words).out
        return [line for line in out.splitlines() if "---" not in line]

    return lines


@pytest.fixture
def silent(client, slaves):
    """Return a function from which on no slave answers on alpha."""
    there = client.read_log

    def read(on, *query, **more):
        if on == "alpha":
            client.asked.append("alpha")
            raise NoMaster("no slave answers on alpha")
        return there(on, *query, **more)

    return lambda: setattr(client, "read_log", read)


# --- all of it --------------------------------------------------------------------------------


def test_a_log_is_copied_byte_by_byte_in_parts(rosrm, client, slaves, monkeypatch):
    monkeypatch.setattr("rosrm.client.logs._PART", 3)
    slaves.write("alpha", 1, "one\ntwo ä\nend".encode())
    result = rosrm("logs", "talker")
    assert (result.code, result.out) == (0, "one\ntwo ä\nend")


def test_dropped_bytes_are_reported_with_their_size(rosrm, client, slaves):
    """Gaps are at the beginning, in place of removed files, and between two files."""
    slaves.write("alpha", 1, b"x" * 2000 + b"\n")
    slaves.rotate("alpha", 1, keep=1)
    slaves.write("alpha", 1, b"y" * 999 + b"\nkept\n")
    slaves.rotate("alpha", 1, keep=1, most=5)
    slaves.write("alpha", 1, b"new\n")
    out = rosrm("logs", "talker").out
    assert out == "--- 3.0 kB before this were dropped ---\nkept\nnew\n"


def test_restarts_and_former_instances_stand_apart(rosrm, client, slaves):
    """Instances follow by number, over all hosts, with a line before each further start."""
    client.events = [event(1, host="beta"), event(2, host="alpha")]
    slaves.write("beta", 1, b"on beta\n")
    slaves.write("alpha", 2, b"oh no\n")
    slaves.start("alpha", 2)
    slaves.write("alpha", 2, b"oh no\n")
    out = rosrm("logs", "talker").out
    out, marks = re.subn(r" at 2023-11-1.T..:..:..\.. ---", "", out)
    assert marks == 2
    again = "--- started on alpha\n"
    assert out == f"on beta\n{again}oh no\n{again}oh no\n"
    assert rosrm("logs", "talker", "--host", "beta").out == "on beta\n"


def test_the_log_of_an_ended_process_is_found_by_its_events(rosrm, client, slaves):
    client.processes = [process("job", "finished", "", number=0, kind="job")]
    client.events = [event(1, process="job", host="alpha"), event(2, process="job", host="")]
    slaves.write("alpha", 1, b"done\n", "job")
    assert rosrm("logs", "job").out == "done\n"


# --- a part of it -----------------------------------------------------------------------------


def test_tail_counts_lines_over_rotations_and_instances(rosrm, slaves, lines):
    slaves.write("alpha", 1, b"a\nb\n")
    slaves.write("alpha", 2, b"c\n")
    slaves.rotate("alpha", 2)
    slaves.write("alpha", 2, b"d\ne")
    slaves.start("alpha", 3)
    for tail, out in ((1, "e"), (2, "d\ne"), (3, "c\nd\ne")):
        assert rosrm("logs", "talker", "--tail", tail).out == out
    assert lines("talker", "--tail", "4") == ["b", "c", "d", "e"]
    result = rosrm("logs", "talker", "--tail", "64kB")
    assert (result.code, "--tail" in result.err) == (2, True)


@pytest.mark.parametrize("lines", [1, 2, 5])
def test_tail_counts_no_line_that_is_written_while_the_log_is_read(rosrm, client, slaves, lines):
    """A process may write more lines between two reads than were requested."""
    slaves.write("alpha", 1, b"".join(b"%d\n" % number for number in range(10)))
    there = client.read_log

    def read(*query, **more):
        part = there(*query, **more)
        slaves.write("alpha", 1, b"late\n" * 20)
        return part

    client.read_log = read
    out = rosrm("logs", "talker", "--tail", lines).out
    assert len(out.splitlines()) == lines


def test_since_begins_at_a_time(rosrm, client, slaves):
    """The bound applies within an instance, and leaves out earlier instances."""
    now = time.time()
    slaves.write("alpha", 1, b"hours ago\n", at=now - 9000)
    slaves.write("alpha", 2, b"an hour ago\n", at=now - 3600)
    slaves.write("alpha", 2, b"a minute ago\n", at=now - 60)
    slaves.write("alpha", 2, b"now\n", at=now)
    assert rosrm("logs", "talker", "--since", "10min").out == "a minute ago\nnow\n"
    assert rosrm("logs", "talker", "--since", "2h").out.endswith("an hour ago\na minute ago\nnow\n")
    assert "hours ago" not in rosrm("logs", "talker", "--since", "2h").out.splitlines()
    result = rosrm("logs", "talker", "--since", "noon")
    assert (result.code, "e.g. 10min" in result.err) == (2, True)


def test_lines_have_times(rosrm, client, slaves):
    """Each line has the time by which it was written."""
    slaves.write("alpha", 1, b"one\ntwo\n")
    slaves.write("alpha", 1, b"three", at=NOON + 5.25)
    lines = rosrm("logs", "talker", "-t").out.splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["one", "two", "three"]
    times = [datetime.fromisoformat(line.split()[0]).timestamp() for line in lines]
    assert times == pytest.approx([NOON, NOON, NOON + 5.2])


def test_several_logs_are_merged_by_time(rosrm, client, slaves, monkeypatch):
    """Each line has its process, also the line before each start, the first one included."""
    monkeypatch.setattr("rosrm.client.logs._PART", 5)
    client.processes = [process("talker"), process("ear", host="beta", number=2)]
    slaves.write("alpha", 1, b"one\ntwo\n", at=NOON + 1)
    slaves.write("beta", 2, b"a\n", "ear", at=NOON)
    slaves.write("beta", 2, b"b\n", "ear", at=NOON + 2)
    slaves.write("alpha", 1, b"three", at=NOON + 3)
    slaves.start("alpha", 1, at=NOON + 4)
    slaves.write("alpha", 1, b"four\n", at=NOON + 5)
    slaves.write("beta", 2, b"c\n", "ear", at=NOON + 6)
    out = re.sub(r" at 20.*", "", rosrm("logs", "talker", "ear").out)
    assert out.splitlines() == [
        "ear    | --- started on beta", "ear    | a",
        "talker | --- started on alpha", "talker | one", "talker | two",
        "ear    | b",
        "talker | three", "talker | --- started on alpha", "talker | four",
        "ear    | c",
    ]  # fmt: skip


def test_lines_without_a_time_stay_where_they_are_in_their_log(client, slaves, lines):
    """An earlier instance may be from before there were times."""
    client.processes = [process("talker"), process("ear")]
    slaves.write("alpha", 1, b"one\n")
    slaves.path("alpha", 2).write_bytes(b"two\n")
    slaves.path("alpha", 2).with_name("talker.2.log.1").write_bytes(b"old\n")
    slaves.write("alpha", 3, b"three\n", at=NOON + 2)
    slaves.write("alpha", 4, b"a\nb\n", "ear", at=NOON + 1)
    assert lines("talker", "ear") == [
        "talker | one", "talker | old", "ear    | a", "ear    | b", "talker | two",
        "talker | three",
    ]  # fmt: skip


# --- missing logs -----------------------------------------------------------------------------


def test_a_program_that_was_never_started_is_reported_with_its_reason(rosrm, client, slaves):
    """The log may exist, and is empty."""
    client.processes = [process("talker", "failed", number=1, reason="no executable 'x' exists")]
    slaves.path("alpha", 1).touch()
    result = rosrm("logs", "talker")
    assert result.code == 1
    assert "it was not started" in result.err
    assert "talker has failed: no executable 'x' exists" in result.err


def test_a_program_without_output_is_reported(rosrm, client, slaves):
    slaves.start("alpha", 1)
    result = rosrm("logs", "talker")
    assert (result.code, result.out) == (0, "")
    assert "talker has written nothing" in result.err


def test_a_process_that_waits_or_is_unknown_is_reported(rosrm, client, slaves):
    result = rosrm("logs", "next")
    assert result.code == 1
    assert "next has no log: it was not started" in result.err
    assert "next is queued: no host has room" in result.err
    result = rosrm("logs", "nobody")
    assert result.code == 1
    assert "no such process: 'nobody'; there are: talker, " in result.err


@pytest.mark.parametrize("state", ["lost", "suspect", "left", "detached"])
def test_a_host_that_is_away_is_not_asked(rosrm, client, slaves, state):
    """The answer comes at once from the master's state, and names the host."""
    client.hosts = [host("alpha", state)]
    client.processes = [process("talker", "unreachable", reason="alpha is lost")]
    result = rosrm("logs", "talker")
    since = "the log of talker is on alpha. talker has been unreachable for 12 s: alpha is lost."
    archive = "or read a log archive (`rosrm logs --archive DIR`)"
    remedy = f"To read it, start the slave of alpha again (`rosrm slave`), {archive}. `rosrm events"
    assert (result.code, f"{since} {remedy}" in result.err) == (1, True)
    client.processes = [process("talker", "unreachable")]
    verb = "has" if state == "left" else "is"
    assert f"the log of talker is on alpha, and alpha {verb}" in rosrm("logs", "talker").err
    client.hosts.append(host("beta"))
    client.events = [event(1, host="beta"), event(2)]
    assert "an older part may be read with `--host beta`." in rosrm("logs", "talker").err
    assert ("read_log", "alpha") not in client.asked


def test_a_log_that_is_nowhere_within_reach_is_not_called_missing(rosrm, client, slaves):
    """The process may have run on the host that is away."""
    client.hosts = [host("beta", "left")]
    client.processes = [process("talker", "queued", host="")]
    client.events = [event(1, host="beta")]
    result = rosrm("logs", "talker")
    assert result.code == 1
    assert "no log of talker is within reach: beta has left: no slave runs there" in result.err
    assert "has no log" not in result.err


def test_older_parts_out_of_reach_are_reported(rosrm, client, slaves):
    client.hosts = [host("alpha"), host("beta", "lost")]
    client.events = [event(1, host="beta"), event(2, host="alpha")]
    slaves.write("alpha", 2, b"new\n")
    result = rosrm("logs", "talker")
    assert (result.code, result.out) == (0, "new\n")
    assert "talker: part of its log cannot be read: beta is lost" in result.err


def test_one_name_that_fails_does_not_keep_the_others(rosrm, client, slaves):
    slaves.write("alpha", 1, b"one\n")
    result = rosrm("logs", "nobody", "talker")
    assert result.code == 1
    assert result.out.endswith("\ntalker | one\n")
    assert "no such process: 'nobody'; there are: talker, " in result.err


def test_a_host_that_does_not_answer_is_asked_once(rosrm, client, slaves, silent):
    """Report each log that is only there, and show those of other hosts at once."""
    client.processes = [process(name, host="alpha") for name in ("one", "two")]
    client.processes.append(process("ear", host="beta", number=3))
    client.events = [event(1, process="ear", host="alpha")]
    slaves.write("beta", 3, b"heard\n", "ear")
    silent()
    result = rosrm("logs", "one", "two", "ear")
    assert client.asked.count("alpha") == 1
    assert result.out.endswith("\near | heard\n")
    assert (result.code, result.err.splitlines()) == (3, [
        "rosrm: one: no slave answers on alpha",
        "rosrm: two: no slave answers on alpha",
        "rosrm: ear: part of its log cannot be read: no slave answers on alpha",
    ])  # fmt: skip


def test_a_lost_host_holds_up_no_other_log(rosrm, client, slaves, while_asleep, monkeypatch):
    """With -f, too, the report comes before the other logs are followed."""
    client.hosts = [host("alpha", "lost"), host("beta")]
    client.processes = [process("talker", "unreachable"), process("ear", host="beta", number=2)]
    slaves.write("beta", 2, b"heard\n", "ear")
    slaves.live.add(("beta", 2))
    capture, reported = StringIO(), []
    monkeypatch.setattr(log_copies.typer, "echo", lambda text, err: capture.write(text))

    def end():
        reported.append(capture.getvalue())
        slaves.live.clear()
        client.processes = [process("ear", "finished")]

    while_asleep(end)
    result = rosrm("logs", "talker", "ear", "-f")
    assert (result.code, result.out.splitlines()[1:]) == (1, ["ear    | heard"])
    assert "the log of talker is on alpha, and alpha is lost" in reported[0]
    assert ("read_log", "alpha") not in client.asked


# --- follow -----------------------------------------------------------------------------------


def test_follow_shows_what_is_added_over_a_rotation(rosrm, client, slaves, while_asleep):
    slaves.write("alpha", 1, b"one\n")
    slaves.live.add(("alpha", 1))

    def rotate():
        slaves.write("alpha", 1, b"thr")
        slaves.rotate("alpha", 1)
        slaves.write("alpha", 1, b"ee\n")

    def end():
        slaves.live.clear()
        client.processes = [process("talker", "finished")]

    while_asleep(lambda: slaves.write("alpha", 1, b"two\n"), rotate, end)
    result = rosrm("logs", "talker", "-f")
    assert (result.code, result.out) == (0, "one\ntwo\nthree\n")


def test_follow_continues_where_the_process_moves_to(rosrm, client, slaves, while_asleep):
    slaves.write("alpha", 1, b"on alpha\n")
    slaves.write("beta", 2, b"on beta\n")
    moved = process("talker", "running", "beta", number=2)
    while_asleep({"processes": [moved]}, {"processes": [process("talker", "finished")]})
    result = rosrm("logs", "talker", "-f")
    assert result.code == 0
    first, mark, last = result.out.splitlines()
    assert (first, last) == ("on alpha", "on beta")
    assert mark.startswith("--- started on beta at ")


def test_follow_waits_for_a_log_that_its_host_is_about_to_begin(
    rosrm, client, slaves, while_asleep
):
    client.processes = [process("talker", "assigned")]

    def refuse(*_, **__):
        raise Refused("this host has no log of talker", "unknown")

    there, client.read_log = client.read_log, refuse
    assert rosrm("logs", "talker").code == 1

    def appear():
        client.read_log = there
        slaves.write("alpha", 1, b"begun\n")

    while_asleep(appear, {"processes": [process("talker", "finished")]})
    result = rosrm("logs", "talker", "-f")
    assert (result.code, result.out) == (0, "begun\n")


def test_several_are_followed_at_once(client, slaves, lines, while_asleep):
    client.processes = [process("talker"), process("ear", number=2)]
    slaves.write("alpha", 1, b"one\n")
    slaves.write("alpha", 2, b"a\n", "ear")
    slaves.live |= {("alpha", 1), ("alpha", 2)}

    def end():
        slaves.write("alpha", 1, b"two\n")
        slaves.write("alpha", 2, b"b\n", "ear")
        slaves.live.clear()
        client.processes = [process("talker", "finished"), process("ear", "finished")]

    while_asleep(end)
    shown = ["talker | one", "ear    | a", "talker | two", "ear    | b"]
    assert lines("talker", "ear", "-f") == shown


def test_a_host_that_is_lost_ends_only_its_own_log(rosrm, client, slaves, while_asleep, silent):
    """Report the lost log with its unfinished line, and follow the other log to its end."""
    client.processes = [process("talker"), process("ear", host="beta", number=2)]
    slaves.write("alpha", 1, b"half")
    slaves.write("beta", 2, b"a\n", "ear")
    slaves.live |= {("alpha", 1), ("beta", 2)}

    def lose():
        silent()
        slaves.write("beta", 2, b"b\n", "ear")

    def end():
        slaves.live.clear()
        client.processes = [process("ear", "finished")]

    while_asleep(lose, end)
    result = rosrm("logs", "talker", "ear", "-f")
    assert [line for line in result.out.splitlines() if "---" not in line] == [
        "ear    | a", "talker | half", "ear    | b",
    ]  # fmt: skip
    assert (result.code, result.err) == (3, "rosrm: talker: no slave answers on alpha\n")


# --- use from a program -----------------------------------------------------------------------


def test_the_client_yields_what_was_written_with_host_and_instance(client, slaves):
    client.events = [event(1, host="beta"), event(2, host="alpha")]
    slaves.write("beta", 1, b"on beta\n")
    slaves.write("alpha", 2, b"on alpha\n")
    chunks = Client(connection=client).logs("talker")
    assert [(one.host, one.number, one.content) for one in chunks] == [
        ("beta", 1, b"on beta\n"), ("alpha", 2, b"on alpha\n"),
    ]  # fmt: skip


def test_the_client_follows_until_its_time_out(client, slaves, monkeypatch):
    slaves.write("alpha", 1, b"one\n")
    slaves.live.add(("alpha", 1))
    monkeypatch.setattr("time.sleep", lambda seconds: slaves.write("alpha", 1, b"two\n"))
    following = Client(connection=client).logs("talker", follow=True, timeout=0.2)
    assert {one.content for one in following} >= {b"one\n", b"two\n"}
