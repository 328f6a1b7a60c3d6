"""Recorder of a master: bounded, beside the loop, and without effect on the master."""

from __future__ import annotations

import os
import stat
import threading
import time

import numpy as np
import pytest

from rosrm.core.master import events as happened
from rosrm.errors import ConfigError
from rosrm.master import recorder
from rosrm.master.recorder import Recorder
from rosrm.model.values import RESOURCE_SLOTS
from rosrm.recording.reader import Header
from tests.unit.tools.simulate.workloads import read


def header(epoch: int = 1, master: str = "lab") -> Header:
    return Header("0.1.0", master, {"name": master}, epoch, 10.0, {})


@pytest.fixture
def start(tmp_path):
    def make(epoch: int = 1, *, master: str = "lab", max_size: int = 10**6, keep: int = 3):
        return Recorder(tmp_path / "records", header(epoch, master), max_size, keep)

    return make


def note(made: Recorder, count: int, begin: int = 0) -> None:
    for number in range(begin, begin + count):
        made.note(happened.CancelRequested(number, ("p",)), 10.0 + number, 1e9 + number, ())


def test_what_was_noted_is_in_the_file_in_order(start):
    made = start()
    note(made, 500)
    made.close("the master stopped: SIGINT")

    record = read(made.path.read_bytes())
    assert record.header == header()
    assert [one.event.request for one in record.events] == list(range(500))
    assert record.end == "the master stopped: SIGINT"


def test_only_its_owner_reads_it(start):
    made = start()
    made.close("done")
    assert stat.S_IMODE(made.path.stat().st_mode) == 0o600


def test_a_full_record_ends_there_and_logs_it(start, caplog):
    made = start(max_size=65536)
    note(made, 5000)
    made.close("the master stopped: SIGINT")

    record = read(made.path.read_bytes())
    assert made.path.stat().st_size <= 65536 + 200  # the end record is still to be written
    assert 100 < len(record.events) < 5000
    assert record.end == "full: it has reached `record.max_size`, 65536 bytes"
    assert "ends here" in caplog.text


class Opened:
    """Open file, for a test that replaces its writes."""

    def __init__(self, inner):
        self.inner = inner

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.inner.close()


class Hung(Opened):
    """File whose writes wait for a release."""

    def __init__(self, inner):
        super().__init__(inner)
        self.go = threading.Event()

    def write(self, content):
        assert self.go.wait(20.0), "the write was not released"
        return self.inner.write(content)


def batch(hosts: int) -> happened.ReadingsReceived:
    numbers = np.arange(hosts, dtype=np.uint64)
    usage = np.zeros((hosts, RESOURCE_SLOTS))
    return happened.ReadingsReceived(
        numbers.astype(np.int64), numbers, numbers, numbers, np.ones(hosts, np.bool_),
        np.zeros(hosts, np.uint32), usage, usage.copy(),
    )  # fmt: skip


@pytest.mark.parametrize("hosts", [1, 1000])
def test_a_disk_that_hangs_ends_the_record_not_the_memory(start, monkeypatch, caplog, hosts):
    """The backlog is bounded in bytes, however many hosts one event concerns."""
    bound = 2**20
    monkeypatch.setattr(recorder, "_BACKLOG", bound)
    made = start(max_size=10**9)
    made._file = hung = Hung(made._file)
    event = batch(hosts)
    content = event.usage.nbytes + event.limit.nbytes
    for number in range(bound // content + 10):
        made.note(event, float(number), 0.0, ())
    waiting = made._queue.qsize()
    assert 0 < waiting * content <= bound
    hung.go.set()
    made.close("the master stopped: SIGINT")
    record = read(made.path.read_bytes())
    assert record.end.startswith("full: the disk could not keep up")
    assert len(record.events) >= waiting - 1
    assert caplog.text.count("could not keep up") == 1


def test_a_disk_that_keeps_up_is_never_too_slow(start, monkeypatch):
    """Written data leaves the backlog, so a record may be many times as large as the bound."""
    made = start(max_size=10**9)
    monkeypatch.setattr(recorder, "_BACKLOG", 64 * 2**10)
    for number in range(50):
        made.note(batch(100), float(number), 0.0, ())
        until = time.monotonic() + 20.0
        while made.waiting and time.monotonic() < until:
            os.sched_yield()
    made.close("done")
    assert len(read(made.path.read_bytes()).events) == 50


@pytest.mark.parametrize("fault", [KeyError("slot"), MemoryError()])
def test_what_cannot_be_encoded_ends_the_record_with_its_reason(start, monkeypatch, caplog, fault):
    """The reason is logged once, no later event is queued, and written data stays whole."""
    encode = recorder.encode

    def broken(event, now, wall):
        if event.request == 3:
            raise fault
        return encode(event, now, wall)

    monkeypatch.setattr(recorder, "encode", broken)
    made = start()
    note(made, 10)
    made._thread.join(20.0)
    assert not made._thread.is_alive()
    note(made, 10, begin=10)
    assert (made.waiting, made._queue.qsize()) == (0, 0)
    made.close("the master stopped: SIGINT")
    record = read(made.path.read_bytes())
    assert [one.event.request for one in record.events] == [0, 1, 2]
    assert record.end.startswith(f"failed: {type(fault).__name__}")
    assert caplog.text.count("ends here") == 1


def test_a_failed_write_ends_the_record_and_is_logged_once(start, caplog):
    class Full(Opened):
        """File on a full disk."""

        def write(self, _content):
            raise OSError(28, "No space left on device")

    made = start()
    made._file = Full(made._file)
    note(made, 100)
    made.close("the master stopped: SIGINT")
    assert caplog.text.count("No space left on device") == 1


def test_each_run_has_its_own_file_and_the_oldest_go(start):
    paths = []
    for epoch in range(1, 6):
        made = start(epoch, keep=2)
        made.close("done")
        os.utime(made.path, (epoch, epoch))
        paths.append(made.path)
    assert [path.exists() for path in paths] == [False, False, False, True, True]
    assert paths[-1].name == "lab-0005.rosrec"


def test_the_records_of_another_master_stay(start):
    other = start(master="lab-2")
    other.close("done")
    for epoch in range(1, 4):
        start(epoch, keep=1).close("done")
    assert other.path.exists()


def test_an_epoch_that_comes_again_overwrites_nothing(start):
    first, second = start(7), start(7)
    first.close("first")
    second.close("second")
    assert second.path.name == "lab-0007.2.rosrec"
    assert read(first.path.read_bytes()).end == "first"


def test_a_directory_that_cannot_be_written_is_refused_with_the_setting(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"record: nothing can be written into .*file/records"):
        Recorder(tmp_path / "file" / "records", header(), 10**6, 3)
