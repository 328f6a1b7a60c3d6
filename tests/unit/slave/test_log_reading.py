"""Parts of a log: requested range, rotations, and the reason where no log exists."""

from __future__ import annotations

import errno
import os
import stat
import time

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from rosrm.errors import Refused
from rosrm.model.values import InstanceId
from rosrm.ros.slave.services import LogQuery
from rosrm.slave import logs
from rosrm.slave.logs import newest_instance, read_log
from rosrm.supervisor import log_index
from rosrm.supervisor.client import log_path
from rosrm.supervisor.log_index import Mark
from rosrm.supervisor.logs import LogKeeper, LogLimits, rotate

P = InstanceId("robot/p", 3)
LINES = b"".join(b"line %d\n" % number for number in range(1000))


@pytest.fixture
def log(tmp_path):
    path = log_path(tmp_path, P)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"0123456789")
    return path


def read(tmp_path, offset=0, most=0, *, ended=False, pid=0, **more):
    query = LogQuery(P.process, P.number, offset, max_bytes=most, **more)
    return read_log(tmp_path, query, ended=ended, pid=pid)


def lack_memory_at(monkeypatch, end: str) -> None:
    """Let the status of a file be unknown for lack of memory."""
    real = os.stat

    def look(path, *others, **options):
        if os.fspath(path).endswith(end):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
        return real(path, *others, **options)

    monkeypatch.setattr(os, "stat", look)


def test_a_rotation_that_lacks_memory_overwrites_no_older_file(log, monkeypatch):
    older = log.with_name(f"{log.name}.1")
    older.write_bytes(b"older")
    lack_memory_at(monkeypatch, ".1")
    rotate(str(log), 10, LogLimits(max_bytes=10, keep=2))
    monkeypatch.undo()
    assert log.with_name(f"{log.name}.2").read_bytes() == b"older"


def test_older_files_that_cannot_be_looked_at_are_not_gone(tmp_path, log, monkeypatch):
    """Otherwise a reader would continue behind them."""
    rotate(str(log), 10, LogLimits(max_bytes=10, keep=1))
    log.write_bytes(b"new")
    lack_memory_at(monkeypatch, ".1")
    with pytest.raises(Refused, match="cannot be read: Cannot allocate memory"):
        read(tmp_path)


def everything(tmp_path, **more):
    """Return all content, with the offsets and sizes of gaps."""
    part = read(tmp_path, 0, **more)
    content, gaps = part.content, [(0, part.offset)] if part.offset and not more else []
    while part.content:
        at = part.next_offset
        part = read(tmp_path, at)
        content += part.content
        if part.content and part.offset > at:
            gaps.append((at, part.offset - at))
    return content, gaps


@pytest.mark.parametrize(
    ("offset", "most", "content", "after"),
    [
        (0, 0, b"0123456789", 10),
        (0, 4, b"0123", 4),
        (4, 4, b"4567", 8),
        (8, 4, b"89", 10),
        (10, 4, b"", 10),
    ],
)
def test_parts(tmp_path, log, offset, most, content, after) -> None:
    """The next offset continues without gap or repetition."""
    part = read(tmp_path, offset, most)
    assert (part.content, part.next_offset) == (content, after)


def test_ended_only_with_everything_read(tmp_path, log) -> None:
    """A follower reads until the last byte, and only then receives the end mark."""
    assert not read(tmp_path, 0, 4, ended=True).ended
    assert read(tmp_path, 4, ended=True).ended
    assert not read(tmp_path, 4, ended=False).ended


@pytest.mark.parametrize("keep", [0, 1, 2])
def test_a_rotation_changes_no_offset(tmp_path, log, keep) -> None:
    """A reader continues at its offset; dropped bytes are a gap of known size."""
    rotate(str(log), 10, LogLimits(max_bytes=6, keep=keep))
    log.write_bytes(b"new")
    part = read(tmp_path, 2)
    if keep:
        assert (part.content, part.offset, part.next_offset) == (b"456789", 4, 10)
        part = read(tmp_path, 10)
    assert (part.content, part.offset, part.next_offset) == (b"new", 10, 13)


def test_what_is_written_while_a_log_is_cut_is_counted(tmp_path, log, monkeypatch) -> None:
    """These bytes cannot be kept; the reader learns their number."""
    copy = log_index.copy_from

    def copy_late(*arguments):
        with log.open("ab") as program:
            program.write(b"late")
        copy(*arguments)

    monkeypatch.setattr(log_index, "copy_from", copy_late)
    rotate(str(log), 10, LogLimits(max_bytes=10, keep=1))
    log.write_bytes(b"new")
    assert everything(tmp_path) == (b"0123456789new", [(10, 4)])


@pytest.mark.parametrize("tail", [1, 2, 3, 250, 999, 1000, 2000])
@pytest.mark.parametrize("end", [b"", b"unfinished"])
def test_tail(tmp_path, log, monkeypatch, tail, end) -> None:
    """The tail has this many lines, over files and blocks; an unfinished line counts."""
    monkeypatch.setattr(logs, "_BLOCK", 50)
    log.write_bytes(LINES[:5000])
    rotate(str(log), 5000, LogLimits())
    log.write_bytes(LINES[5000:] + end)
    wanted = [*LINES.splitlines(keepends=True), *([end] if end else [])][-tail:]
    assert everything(tmp_path, tail=tail)[0] == b"".join(wanted)


def test_tail_of_a_log_that_was_just_rotated(tmp_path, log) -> None:
    """The current file is empty: the lines are those of the file before."""
    log.write_bytes(LINES)
    rotate(str(log), len(LINES), LogLimits())
    assert everything(tmp_path, tail=2)[0] == b"line 998\nline 999\n"


def test_since(tmp_path, log) -> None:
    """The part begins with the first byte that may have been written at that time."""
    log.write_bytes(b"abcdef")
    log_index.begin(str(log), Mark(10.0, 0, 7))
    for when, offset in ((11.0, 2), (13.0, 6)):
        log_index.add(str(log), Mark(when, offset, 0))
    rotate(str(log), 6, LogLimits())
    log.write_bytes(b"gh")
    log_index.add(str(log), Mark(4e9, 8, 0))
    for since, content in (
        (9.0, b"abcdefgh"),
        (10.5, b"abcdefgh"),
        (12.0, b"cdefgh"),
        (3e9, b"gh"),
    ):
        assert everything(tmp_path, since=since)[0] == content
    assert everything(tmp_path, since=5e9)[0] == b""


def test_marks_cover_a_part(tmp_path, log) -> None:
    """Each byte has a later mark, the newest ones the time of reading; starts have their pid."""
    log_index.begin(str(log), Mark(10.0, 0, 7))
    log_index.add(str(log), Mark(11.0, 4, 0))
    log_index.add(str(log), Mark(12.0, 4, 8))
    part = read(tmp_path)
    assert part.marks[:3] == [(10.0, 0, 7), (11.0, 4, 0), (12.0, 4, 8)]
    assert part.marks[3][1] == 10
    assert [mark[1] for mark in read(tmp_path, 2, 2).marks] == [4]


def test_an_answer_with_many_marks_ends_sooner(tmp_path, log, monkeypatch) -> None:
    """The next answer continues there."""
    monkeypatch.setattr(logs, "_MOST_MARKS", 5)
    log_index.begin(str(log), Mark(10.0, 0, 1))
    for offset in range(1, 11):
        log_index.add(str(log), Mark(10.0, offset, 0))
    assert read(tmp_path).next_offset == 4
    assert everything(tmp_path) == (b"0123456789", [])


DROPPED = [
    ({}, b"whole\nend"), ({"tail": 9}, b"whole\nend"), ({"since": 5.0}, b"whole\nend"),
    ({"tail": 1}, b"end"), ({"offset": 9}, b"alf\nwhole\nend"),
]  # fmt: skip


@pytest.mark.parametrize(("query", "content"), DROPPED)
def test_what_follows_dropped_bytes_begins_with_a_whole_line(tmp_path, log, query, content) -> None:
    """The rest of a line counts as dropped, except for a reader that has read its beginning."""
    log.write_bytes(b"dropped\nhalf\nwhole\nend")
    log_index.begin(str(log), Mark(10.0, 0, 0))
    log_index.add(str(log), Mark(11.0, 22, 0))
    rotate(str(log), 22, LogLimits(max_bytes=13, keep=1))
    part = read(tmp_path, **query)
    assert (part.content, part.offset) == (content, 22 - len(content))


@pytest.mark.parametrize("content", [b"only a line\n", b"no line"])
def test_the_only_line_after_dropped_bytes_stays(tmp_path, log, content) -> None:
    rotate(str(log), 10, LogLimits(keep=0))
    log.write_bytes(content)
    assert everything(tmp_path) == (content, [(0, 10)])


def test_what_a_program_wrote_first_after_dropped_bytes_stays(tmp_path, log) -> None:
    """A start begins a line."""
    rotate(str(log), 10, LogLimits(keep=0))
    log_index.add(str(log), Mark(4e9, 10, 7))
    log.write_bytes(b"first\nsecond\n")
    assert everything(tmp_path) == (b"first\nsecond\n", [(0, 10)])


def test_one_answer_is_bounded(tmp_path, log) -> None:
    """A large request gets its answer in several messages."""
    log.write_bytes(b"x" * (3 << 20))
    assert len(read(tmp_path, most=0).content) == len(read(tmp_path, most=2**32 - 1).content)
    assert len(read(tmp_path).content) <= 1 << 20


def test_a_missing_log_is_refused(tmp_path) -> None:
    """The refusal names no path: everybody may ask."""
    with pytest.raises(Refused, match="no log of robot/p#3") as refusal:
        read(tmp_path)
    assert str(tmp_path) not in str(refusal.value)
    with pytest.raises(Refused, match="no log of nobody"):
        newest_instance(tmp_path, "nobody")


def test_a_log_that_cannot_be_read_is_refused_without_its_path(tmp_path) -> None:
    """A name of 300 letters ended the slave by an `OSError`."""
    (tmp_path / "logs").mkdir()
    query = LogQuery("p" * 300, 1)
    with pytest.raises(Refused, match="cannot be read: File name too long") as refusal:
        read_log(tmp_path, query, ended=True)
    assert str(tmp_path) not in str(refusal.value)


@given(
    st.builds(
        LogQuery,
        st.sampled_from([P.process, "", ".", "..", "../../etc/passwd", "/etc/passwd", "a\0b"])
        | st.text(),
        st.just(P.number) | st.integers(0, 2**64 - 1),
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
        st.floats(),
        st.integers(0, 2**32 - 1),
    )
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_any_request_is_answered_with_a_part_or_a_refusal(tmp_path, log, query) -> None:
    """Whatever a client sends, the slave raises nothing else, and names no path."""
    log.write_bytes(b"a line\n" * 100)
    refusal, part = "", None
    try:
        part = read_log(tmp_path, query, ended=True)
    except Refused as refused:
        refusal = str(refused)
    assert str(tmp_path) not in refusal
    assert part is None or 0 <= part.offset <= part.next_offset <= 700


def test_newest_instance(tmp_path, log) -> None:
    """Numbers are compared as numbers: 10 is newer than 9; rotated and other files do not count."""
    for number in (9, 10):
        log_path(tmp_path, InstanceId("robot/p", number)).write_bytes(b"")
    for process in ("robot", "robot/p.11", "p", "robot/p/12"):
        log_path(tmp_path, InstanceId(process, 99)).write_bytes(b"")
    for suffix in (".1", ".parameters.yaml", ".times"):
        path = log_path(tmp_path, InstanceId("robot/p", 11))
        path.with_name(path.name + suffix).write_bytes(b"")
    assert newest_instance(tmp_path, "robot/p") == InstanceId("robot/p", 10)
    assert read(tmp_path).numbers == (3, 9, 10)


# --- logs written by the supervisor -----------------------------------------------------------


@pytest.fixture
def keeper(tmp_path):
    log_path(tmp_path, P).parent.mkdir(parents=True)
    return LogKeeper(str(tmp_path), LogLimits(max_bytes=100, keep=1), {})


def start(keeper, pid, content=b""):
    key = (P.process, P.number)
    program = keeper.open(key)
    keeper.watch(key, 0.0, pid)
    os.write(program, content)
    os.close(program)


def test_starts_and_growth_are_noted(tmp_path, keeper) -> None:
    """A restart writes into the same file; the supervisor records where it begins."""
    start(keeper, 7, b"oh no\n")
    keeper.look(1e9)
    start(keeper, 8, b"oh no\n")
    keeper.release((P.process, P.number))
    marks = read(tmp_path, ended=True).marks
    assert [mark[1:] for mark in marks] == [(0, 7), (6, 0), (6, 8), (12, 0)]


def test_a_program_without_output_needs_no_index(tmp_path, keeper) -> None:
    """A short job without output leaves only one file."""
    start(keeper, 7)
    keeper.look(1e9)
    keeper.release((P.process, P.number))
    assert [file.name for file in log_path(tmp_path, P).parent.iterdir()] == ["robot%2Fp.3.log"]


def test_a_start_is_known_before_the_first_look(tmp_path, keeper) -> None:
    """Before the supervisor creates the index, a reader gets the mark of the program's start."""
    before = time.time() - 1.0  # the kernel stamps files with a coarse clock
    start(keeper, 7, b"hello\n")
    (when, *first), *_ = read(tmp_path, pid=7).marks
    assert first == [0, 7]
    assert before < when <= time.time()
    assert [mark[1:] for mark in read(tmp_path, 2, pid=7).marks] == [(6, 0)]


@pytest.mark.parametrize("died", [False, True])
def test_offsets_continue_in_another_supervisor(tmp_path, keeper, died) -> None:
    """Rotations before and after the restart count alike."""
    start(keeper, 7, b"x" * 150)
    keeper.look(1e9)
    if died:
        keeper = LogKeeper(str(tmp_path), LogLimits(max_bytes=100, keep=1), {})
        keeper.watch((P.process, P.number), 0.0)
    with log_path(tmp_path, P).open("ab") as program:
        program.write(b"y" * 120)
    keeper.look(2e9)
    with log_path(tmp_path, P).open("ab") as program:
        program.write(b"z")
    assert everything(tmp_path) == (b"y" * 100 + b"z", [(0, 170)])


def test_a_log_that_was_cut_without_a_note_is_read_on(tmp_path, keeper) -> None:
    """A user, or a supervisor killed during a rotation, may have cut it."""
    start(keeper, 7, b"first\n")
    keeper.look(1e9)
    log_path(tmp_path, P).write_bytes(b"2\n")
    keeper = LogKeeper(str(tmp_path), LogLimits(max_bytes=100, keep=1), {})
    keeper.watch((P.process, P.number), 0.0)
    keeper.look(2e9)
    assert everything(tmp_path) == (b"2\n", [(0, 6)])


def test_a_log_from_before_there_were_times(tmp_path, keeper) -> None:
    """The bytes of an older log count; their time is that of the first look."""
    log_path(tmp_path, P).write_bytes(b"old\n")
    start(keeper, 7, b"new\n")
    keeper.look(1e9)
    assert everything(tmp_path) == (b"old\nnew\n", [])


def test_all_files_are_for_their_owner_alone(tmp_path, keeper) -> None:
    """Rotated logs and indices are as private as the current log."""
    start(keeper, 7, b"x" * 150)
    keeper.look(1e9)
    files = list(log_path(tmp_path, P).parent.iterdir())
    assert len(files) == 4
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}


def test_an_index_is_bounded_like_its_log(tmp_path, keeper) -> None:
    """Rotate a log of a few bytes whose index exceeds `max_bytes`, and lose no byte of the log."""
    start(keeper, 7)
    for look in range(1, 7):
        with log_path(tmp_path, P).open("ab") as program:
            program.write(b".")
        keeper.look(look * 1e9)
        files = log_path(tmp_path, P).parent.glob("*.times*")
        assert all(file.stat().st_size <= 100 + 24 for file in files)
    assert everything(tmp_path)[0] == b"." * 6


def test_a_loop_of_crashes_without_output_does_not_let_an_index_grow(tmp_path, keeper) -> None:
    """The index keeps only the newest of several starts without output in between."""
    for pid in range(7, 30):
        start(keeper, pid)
        keeper.release((P.process, P.number))
    start(keeper, 30, b"a word\n")
    keeper.release((P.process, P.number))
    for pid in range(31, 50):
        start(keeper, pid)
        keeper.release((P.process, P.number))
    with log_index.Index(str(log_path(tmp_path, P))) as index:
        assert [mark[1:] for mark in index.marks(0, 99)] == [(0, 30), (7, 0), (7, 49)]


def test_a_log_of_a_former_owner_of_the_name_is_not_there(tmp_path, log) -> None:
    """Neither its content nor its number is shown to a reader with a ticket from a later number."""
    log_path(tmp_path, InstanceId(P.process, 5)).write_bytes(b"new")
    assert read(tmp_path, first=3).numbers == (3, 5)
    with pytest.raises(Refused, match=r"no log of robot/p#3 \(any more\)") as refusal:
        read(tmp_path, first=4)
    assert refusal.value.code == "unknown"
    part = read_log(tmp_path, LogQuery(P.process, 5, first=4), ended=False)
    assert (part.content, part.numbers) == (b"new", (5,))


def test_a_log_that_cannot_be_rotated_is_truncated_all_the_same(log) -> None:
    """A process may make a folder of that name; its log must not fill the disk."""
    log.write_bytes(LINES)
    log.with_name(f"{log.name}.new").mkdir()
    with pytest.raises(OSError, match="Is a directory"):
        rotate(str(log), len(LINES), LogLimits())
    assert log.stat().st_size == 0
