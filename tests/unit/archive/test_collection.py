"""Collection of logs into an archive: each byte once, whatever is rotated, killed or lost."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosrm.archive import writer
from rosrm.archive.reader import LogArchive
from rosrm.archive.retention import ArchiveLimits
from rosrm.client import log_collection
from rosrm.errors import Refused
from rosrm.model.rows import LogPart
from tests.unit.archive.rig import HOST, PROCESS, Master, Rig
from tests.unit.cli.conftest import host, process


class Crash(BaseException):
    """The collector is killed."""


class Shipping(RuleBasedStateMachine):
    """A process writes, its log is rotated, and a collector is killed and started at any moment.

    Its segments and requests are tiny, so that most steps begin, close or continue one.
    """

    @initialize()
    def begin(self):
        self.folder = Path(tempfile.mkdtemp())
        self.small = [
            patch.object(writer, "SEGMENT_BYTES", 100), patch.object(log_collection, "PART", 23),
            patch.object(log_collection, "TURN", 70), patch.object(log_collection, "_OVERLAP", 8),
        ]  # fmt: skip
        for one in self.small:
            one.start()
        self.rig = Rig(self.folder)
        self.written = b""
        self.next = 0

    @rule(lines=st.integers(1, 20), ends=st.booleans())
    def write(self, lines, ends):
        """Each line differs, so that a byte in another place is found."""
        content = b"".join(b"line %d\n" % (self.next + at) for at in range(lines))
        self.next += lines
        content = content if ends else content[:-3]
        self.rig.alpha.write(content)
        self.written += content

    @rule()
    def rotate(self):
        self.rig.alpha.rotate()

    @rule(looks=st.integers(1, 3))
    def collect(self, looks):
        self.rig.collect(looks)

    @rule()
    def start_again(self):
        self.rig.start()

    @rule()
    def host_returns(self):
        """The host was away, and the collector missed nothing that it can still get."""
        self.rig.master.hosts = [host(HOST, "lost")]
        self.rig.collect()
        self.rig.master.hosts = [host(HOST)]

    @rule(
        at=st.sampled_from(["append_durably", "_add_marks", "_compress", "_remove"]),
        calls=st.integers(0, 3), part=st.integers(0, 30),
    )  # fmt: skip
    def crash(self, at, calls, part):
        """Kill the collector before a step, or in the middle of writing; start the next one."""
        module = writer.durable if at == "append_durably" else writer
        there, left = getattr(module, at), iter(range(calls))

        def crash(*given):
            if next(left, None) is None:
                if module is writer.durable:
                    there(given[0], given[1][:part])
                raise Crash
            there(*given)

        with patch.object(module, at, crash), contextlib.suppress(Crash):
            self.rig.collect(2)
        self.rig.start()

    @invariant()
    def what_is_stored_was_written(self):
        if not hasattr(self, "rig") or not self.rig.files():
            return
        stored = self.rig.chunks(most=50)
        assert stored in ([], [(0, self.written[: len(stored[0][1]) if stored else 0])])

    def teardown(self):
        try:
            if self.written:
                self.rig.collect(len(self.written) // 70 + 2)
                assert self.rig.chunks(most=50) == [(0, self.written)]
        finally:
            for one in self.small:
                one.stop()
            shutil.rmtree(self.folder)


TestShipping = Shipping.TestCase
TestShipping.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)


def fail_with(error):
    def fail(*_):
        raise error

    return fail


@pytest.fixture
def rig(tmp_path, monkeypatch):
    return Rig(tmp_path)


def test_dropped_output_is_a_gap_at_its_offset(rig):
    """The host's own bound removed output before the collector came."""
    rig.alpha.write(b"x" * 50 + b"\n")
    rig.collect()
    rig.alpha.write(b"y" * 50 + b"\n")
    rig.alpha.rotate(keep=0)
    rig.alpha.write(b"new\n")
    rig.collect()
    assert rig.chunks() == [(0, b"x" * 50 + b"\n"), (102, b"new\n")]


def test_each_start_and_time_is_stored_with_the_output(rig):
    rig.alpha.write(b"one\n", at=1_700_000_000.0)
    rig.alpha.write(b"two\n", at=1_700_000_009.0)
    rig.collect()
    assert list(rig_part(rig).marks[:3]) == [
        (1_700_000_000.0, 0, 77), (1_700_000_000.0, 4, 0), (1_700_000_009.0, 8, 0),
    ]  # fmt: skip


def rig_part(rig):
    return LogArchive(rig.directory).read_log(HOST, PROCESS, 1, 0)


def test_an_ended_log_is_compressed_and_not_asked_for_again(rig):
    rig.alpha.write(b"done\n" * 100)
    rig.alpha.ended.add((PROCESS, 1))
    rig.master.processes = [process(PROCESS, "finished", host=HOST)]
    rig.collect()
    assert rig.files() == ["nav.1.0.0-500.log.gz", "nav.1.0.0-500.times.gz"]
    asked = len(rig.master.asked)
    rig.collect(3)
    assert len(rig.master.asked) == asked


def test_former_hosts_are_found_by_their_events(rig):
    """The process has moved before the collector was started."""
    rig.master.processes = [process(PROCESS, host="beta", number=2)]
    rig.master.note(kind="migrated", host="beta")
    rig.master.events[-1] = replace(rig.master.events[-1], facts={"from": HOST})
    rig.alpha.write(b"before\n")
    rig.collect()
    assert rig.chunks() == [(0, b"before\n")]


def test_events_after_a_journal_gap_are_seen(rig):
    """They have the sequences of events that the collector has seen, and the master has lost."""
    rig.master.processes = [process(PROCESS, "finished", host=HOST)]
    rig.master.note(kind="assigned", host=HOST)
    rig.master.note(kind="finished", host=HOST)
    rig.alpha.write(b"one\n")
    rig.alpha.ended.add((PROCESS, 1))
    rig.collect(2)
    rig.alpha.write(b"two\n", 2)
    rig.master.events.pop()
    rig.master.note(kind="master_started")
    rig.collect()
    assert rig.chunks(2) == [(0, b"two\n")]


def test_another_log_of_the_same_number_is_another_generation(rig):
    """The state directory of the host was removed; the new log may be shorter or longer."""
    rig.alpha.write(b"former %d\n" % 7 * 3)
    rig.collect()
    for content in (b"second\n", b"third, and longer than the second\n" * 3):
        rig.alpha.remove_logs()
        rig.alpha.write(content)
        rig.start()
        rig.collect()
    former = b"former 7\n" * 3
    assert rig.chunks() == [(0, former + b"second\n" + b"third, and longer than the second\n" * 3)]
    rig.start()
    rig.collect()
    assert [name.split(".")[2] for name in rig.files() if name.endswith((".log", ".gz"))] == [
        "0", "0", "1", "1", "2",
    ]  # fmt: skip


def test_a_host_that_has_lost_its_newest_bytes_doubles_nothing(rig):
    """A power failure on the host; the archive already has those bytes."""
    rig.alpha.write(b"one\ntwo\nthree\n")
    rig.collect()
    os.truncate(rig.alpha.path(), 8)
    rig.alpha.ended.add((PROCESS, 1))
    rig.start()
    rig.collect()
    assert rig.chunks() == [(0, b"one\ntwo\nthree\n")]


@pytest.mark.parametrize("lost", [slice(8, 14), slice(8, 11)], ids=["all", "a block"])
def test_a_loss_of_power_during_an_append_leaves_no_zeros_and_doubles_nothing(rig, lost):
    """Size or further blocks may be there without the bytes before them."""
    rig.alpha.write(b"one\ntwo\nthree\n")
    rig.collect()
    (path,) = rig.directory.glob("hosts/*/*.log")
    content = bytearray(path.read_bytes())
    content[lost] = bytes(lost.stop - lost.start)
    path.write_bytes(content)
    rig.start()
    rig.collect()
    assert rig.chunks() == [(0, b"one\ntwo\nthree\n")]


@pytest.mark.parametrize("left", [0, 10], ids=["gone", "rotated"])
def test_zeros_of_a_log_whose_host_has_them_no_more_stay(rig, left):
    """Its own zeros, for example: nothing is removed that the host cannot send again."""
    rig.alpha.write(b"one\n\0\0\0\0three\n")
    rig.collect()
    rig.alpha.write(b"four\n")
    if left:
        rig.alpha.rotate(keep=0)
        rig.alpha.write(b"five\n")
    else:
        rig.master.silent.add(HOST)
    rig.start()
    rig.collect()
    found = rig.chunks()
    assert found[0] == (0, b"one\n\0\0\0\0three\n")
    assert found[1:] == ([(19, b"five\n")] if left else [])


def test_a_silent_host_is_named_once_and_collected_when_it_answers(rig, monkeypatch):
    rig.alpha.write(b"one\n")
    rig.master.silent.add(HOST)
    rig.collect(3)
    assert len(rig.master.asked) == 1  # each request to it would wait for 10 s
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: 1e9)
    assert rig.said == ["the slave of alpha does not answer"]
    rig.master.silent.clear()
    rig.collect()
    assert rig.chunks() == [(0, b"one\n")]


def test_a_host_that_sends_a_byte_at_a_time_holds_up_no_other_log(rig, monkeypatch):
    """After a few requests another log has its turn; the rest is collected later."""
    rig.alpha.write(b"x" * 100)

    def read_log(host, name, number=0, offset=0, _=0):
        return Master.read_log(rig.master, host, name, number, offset, 1)

    monkeypatch.setattr(rig.master, "read_log", read_log)
    rig.collect()
    assert len(rig.master.asked) < 50
    rig.collect(looks=20)
    assert rig.chunks(most=100) == [(0, b"x" * 100)]


def test_a_log_that_is_removed_while_it_is_collected_holds_up_no_newer_one(rig, monkeypatch):
    """The slave removed the log of an instance after it had named it."""
    rig.alpha.write(b"old", 1)
    rig.alpha.write(b"new", 2)
    rig.master.processes = [process(PROCESS, host=HOST, number=2)]

    def read_log(host, name, number=0, *rest):
        if number == 1 and rig.alpha.path(1).exists():
            rig.alpha.path(1).unlink()
            raise Refused("no log", "unknown")
        return Master.read_log(rig.master, host, name, number, *rest)

    monkeypatch.setattr(rig.master, "read_log", read_log)
    rig.collect(looks=2)
    assert rig.chunks(2) == [(0, b"new")]


def test_appended_output_is_forced_to_the_disk(rig, monkeypatch):
    """Otherwise a loss of power may leave its size alone, and zeros would count as output."""
    synced = []

    def noted(file):
        synced.append((Path(f"/proc/self/fd/{file}").readlink().name, os.fstat(file).st_size))
        real(file)

    real = os.fdatasync
    monkeypatch.setattr(os, "fdatasync", noted)
    for size in (4, 8):
        rig.alpha.write(b"one\n")
        rig.collect()
        assert synced.pop()[1] == size


def test_a_full_disk_loses_and_doubles_nothing(rig, monkeypatch):
    """A part of the bytes was written before the disk was full."""
    rig.alpha.write(b"one\ntwo\n")
    real = os.write

    def full(file, content):
        if len(content) < 8:
            raise OSError(28, "No space left on device")
        return real(file, content[:3])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space left"):
        rig.collect()
    monkeypatch.setattr(os, "write", real)
    rig.collect()
    assert rig.chunks() == [(0, b"one\ntwo\n")]


def test_the_bounds_end_a_full_disk_that_one_look_has_filled(tmp_path, monkeypatch):
    """One look may store more than the bound before the bounds are applied."""
    rig = Rig(tmp_path, ArchiveLimits(5 * 8192, 1 << 40))
    for number in range(1, 11):
        rig.alpha.write(os.urandom(8000), number)
        rig.alpha.ended.add((PROCESS, number))
    append = writer.durable.append_durably

    def bounded(path, content):
        if sum(one.stat().st_size for one in rig.directory.rglob("*")) > 7 * 8192:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(path, content)

    monkeypatch.setattr(writer.durable, "append_durably", bounded)
    with pytest.raises(OSError, match="No space left"):
        rig.collect()
    rig.collect()
    assert len(rig.chunks(10, most=8000)[0][1]) == 8000


def test_a_file_that_somebody_removes_is_collected_again(rig):
    """The look fails once; the host still has the bytes."""
    rig.alpha.write(b"one\n")
    rig.collect()
    (file,) = rig.directory.glob("hosts/*/*.log")
    file.unlink()
    rig.alpha.write(b"two\n")
    with pytest.raises(FileNotFoundError):
        rig.collect()
    rig.collect()
    assert rig.chunks() == [(0, b"one\ntwo\n")]


def test_a_quiet_log_is_asked_for_less_and_less_often(rig, monkeypatch):
    """An event about the process ends the wait."""
    now = [0.0]
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: now[0])
    rig.collector._every = 2.0
    rig.alpha.write(b"one\n")
    rig.collect()
    waits = []
    for _ in range(6):
        log = rig.collector._logs[HOST, PROCESS]
        waits.append(log.due - now[0])
        now[0] = log.due
        rig.collect()
    assert waits == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    rig.alpha.write(b"two\n")
    rig.master.note(kind="backoff", host=HOST)
    rig.collect()
    assert rig.chunks() == [(0, b"one\ntwo\n")]


# --- bounds -----------------------------------------------------------------------------------


def test_the_oldest_output_is_removed_first_and_never_collected_again(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "SEGMENT_BYTES", 1000)
    rig = Rig(tmp_path, ArchiveLimits(5 * 8192, 1 << 40))
    for number in range(1, 9):
        rig.alpha.write(b"%d" % number * 999 + b"\n", number)
        rig.alpha.ended.add((PROCESS, number))
        rig.master.processes = [process(PROCESS, "finished", host=HOST, number=number)]
        rig.master.note(host=HOST)
        rig.collect()
        for path in rig.directory.glob(f"hosts/alpha/nav.{number}.*"):
            os.utime(path, (number, number))
    rig.start()
    rig.collect(2)
    kept = [number for number in range(1, 9) if rig.chunks(number)]
    assert kept == [4, 5, 6, 7, 8]
    assert sum(path.stat().st_size for path in rig.directory.glob("hosts/alpha/nav.1.*")) == 0


def test_many_small_logs_count_with_their_room_on_the_disk(tmp_path):
    """Each file takes at least a block, although its output has a few bytes."""
    rig = Rig(tmp_path, ArchiveLimits(1_000_000, 1_000_000))
    for number in range(1, 201):
        rig.alpha.write(b"done\n", number)
        rig.alpha.ended.add((PROCESS, number))
        rig.master.note(host=HOST)
        rig.collect()
    blocks = [-(-path.stat().st_size // 4096) for path in rig.directory.glob("hosts/*/*")]
    assert sum(blocks) * 4096 < 1_050_000


def test_open_logs_are_closed_where_they_alone_exceed_a_bound(tmp_path):
    """Many running processes may each have a log that is not closed yet."""
    rig = Rig(tmp_path, ArchiveLimits(1 << 40, 3 * 8192))
    rig.writer._limits = ArchiveLimits(20_000, 20_000)
    rig.alpha.write(b"x" * 100_000)
    rig.collect()
    assert [name for name in rig.files() if name.endswith(".log.gz")] == ["nav.1.0.0-100000.log.gz"]


# --- hostile hosts ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["../../evil", "..", ".hidden", "a/b", "-", "\0", "collector.lock"]
)
def test_no_name_leads_out_of_the_archive(tmp_path, name):
    rig = Rig(tmp_path)
    rig.master.slaves = {name: rig.alpha}
    rig.master.hosts = [host(name)]
    rig.master.processes = [process("../" + PROCESS, host=name)]
    rig.alpha.write(b"one\n", name="../" + PROCESS)
    rig.collect()
    (log,) = rig.directory.glob("hosts/*/*.log")
    assert log.read_bytes() == b"one\n"
    assert {path.name for path in tmp_path.iterdir()} == {"alpha", "archive"}


def test_a_name_that_is_too_long_holds_up_no_other_log(rig):
    name = "/" * 100
    rig.alpha.read_log = lambda *_: LogPart(1, (1,), b"one\n", 0, 4, True, ())
    rig.master.processes = [process(name, host=HOST), process(PROCESS, host=HOST)]
    rig.collect()
    assert rig.said == [f"the log of {name} on alpha: its name is too long for a file"]
    assert rig.chunks() == [(0, b"one\n")]


PARTS = [
    {"number": 2}, {"next_offset": 99}, {"content": b"x" * (1 << 20), "next_offset": 1 << 20},
]  # fmt: skip


@pytest.mark.parametrize("wrong", PARTS)
def test_an_impossible_part_is_refused(rig, wrong):
    """The other logs are collected nevertheless."""
    good = LogPart(1, (1,), b"one\n", 0, 4, False, ())
    rig.master.read_log = lambda host, process, number, *_: (
        replace(good, **wrong) if number else good
    )
    rig.collect()
    (said,) = rig.said
    assert said.endswith("alpha sent an impossible part of the log of nav#1")
    assert rig.files() == []


def test_impossible_times_are_left_out(rig):
    marks = [
        (math.nan, 1, 0), (math.inf, 2, 0), (-5.0, 2, 0), (1e300, 2, 0), (7.0, 3, 0), (8.0, 1, 9),
        (9.0, 1 << 63, 5),
    ]  # fmt: skip
    part = LogPart(1, (1,), b"one\n", 0, 4, True, marks)
    rig.master.read_log = lambda *_: part
    rig.collect()
    assert list(rig_part(rig).marks) == [(7.0, 3, 0), (9.0, 4, 0)]


def test_a_sentence_is_forgotten_with_its_process(rig):
    """Names of jobs never end; a process that returns with the same error is reported again."""
    rig.alpha.read_log = fail_with(Refused("the disk is damaged", "failed"))
    for name in ("job-1", "job-2"):
        rig.master.processes = [process(name, host=HOST)]
        rig.collect(2)
    assert [text.split()[3] for text in rig.said] == ["job-1", "job-2"]
    assert list(rig.collector._said) == [(HOST, "job-2")]
