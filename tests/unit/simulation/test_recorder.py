"""The recorder of a master: bounded, beside the loop, and never the master's end."""

from __future__ import annotations

import os
import stat

import pytest

from rosrm.core import events as happened
from rosrm.errors import ConfigError
from rosrm.master import recorder
from rosrm.master.recorder import Recorder
from rosrm.recording.reading import Header

from .workloads import read


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


def test_a_full_record_ends_there_and_says_so(start, caplog):
    made = start(max_size=65536)
    note(made, 5000)
    made.close("the master stopped: SIGINT")

    record = read(made.path.read_bytes())
    assert made.path.stat().st_size <= 65536 + 200  # its end still has to go in
    assert 100 < len(record.events) < 5000
    assert record.end == "full: it has reached `record.max_size`, 65536 bytes"
    assert "ends here" in caplog.text


def test_a_disk_that_falls_behind_ends_the_record_not_the_memory(start, monkeypatch, caplog):
    monkeypatch.setattr(recorder, "_BACKLOG", 10)
    made = start()

    class Behind:
        """A queue in which much waits."""

        def __init__(self, inner):
            self.inner = inner

        def qsize(self):
            return 10

        def __getattr__(self, name):
            return getattr(self.inner, name)

    made._queue = Behind(made._queue)
    note(made, 3)
    made.close("the master stopped: SIGINT")
    assert read(made.path.read_bytes()).end.startswith("full: the disk could not keep up")
    assert caplog.text.count("could not keep up") == 1


def test_a_write_that_fails_ends_the_record_and_is_said_once(start, caplog):
    made = start()

    class Full:
        """A file on a full disk."""

        def __init__(self, inner):
            self.inner = inner

        def write(self, _content):
            raise OSError(28, "No space left on device")

        def flush(self):
            self.inner.flush()

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.inner.close()

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
