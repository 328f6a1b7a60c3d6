"""Log files of the processes, and their indices, on a disk that fails."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from rosrm.supervisor import log_index, logs, paths
from rosrm.supervisor.log_calls import LogCalls
from rosrm.supervisor.log_index import Mark
from rosrm.supervisor.logs import LogKeeper, LogLimits


@pytest.fixture
def state(tmp_path):
    Path(paths.log_folder(str(tmp_path))).mkdir()
    return str(tmp_path)


def test_an_old_log_that_cannot_be_removed_prevents_no_start(state, monkeypatch, capfd):
    """The log of the new instance is opened, and no descriptor is lost."""
    keeper = LogKeeper(state, LogLimits(instances=1), {})
    os.close(keeper.open(("talker", 1)))

    def refuse(path: str) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted", path)

    monkeypatch.setattr(logs.os, "unlink", refuse)
    before = set(Path("/proc/self/fd").iterdir())
    log = keeper.open(("talker", 2))
    assert os.write(log, b"hello\n") == 6
    os.close(log)
    left = set(Path("/proc/self/fd").iterdir())
    assert left <= before  # a descriptor of something else may have been closed
    assert "talker.1" in capfd.readouterr().err


def test_a_log_that_was_opened_ahead_is_opened_again_if_a_user_removed_it(state):
    """Otherwise the output would go to a file without a name."""
    keeper, path = LogKeeper(state, LogLimits(), {}), Path(paths.log_file(state, "talker", 1))
    keeper.prepare(("talker", 1))
    path.unlink()
    log = keeper.open(("talker", 1))
    os.write(log, b"hello\n")
    os.close(log)
    assert path.read_text() == "hello\n"


def test_a_log_that_was_opened_ahead_displaces_no_log_before_its_start(state):
    """A held job that never starts has no log, so it takes the place of none."""
    keeper = LogKeeper(state, LogLimits(instances=2), {})

    def kept() -> list[str]:
        return sorted(path.name for path in Path(paths.log_folder(state)).iterdir())

    for number in (1, 2):
        os.close(keeper.open(("job", number)))
    keeper.prepare(("job", 3))
    keeper.release(("job", 3))
    assert kept() == ["job.1.log", "job.2.log"]
    keeper.prepare(("job", 4))
    os.close(keeper.open(("job", 4)))
    assert kept() == ["job.2.log", "job.4.log"]


def test_an_index_without_room_stays_as_it_was(state, monkeypatch):
    """Half a record would move all offsets, and the new file would stay beside the old one."""
    log, write = paths.log_file(state, "talker", 1), os.write
    log_index.begin(log, Mark(10.0, 4711, 0))

    def write_a_part(file: int, data: bytes) -> int:
        if len(data) < 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[:10])

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", write_a_part)
        with pytest.raises(OSError, match="No space left"):
            log_index.begin(log, Mark(11.0, 4800, 0))
    assert log_index.base(log) == 4711
    folder = Path(paths.log_folder(state))
    assert [path.name for path in folder.iterdir()] == ["talker.1.log.times"]


def test_a_failed_release_of_a_log_is_reported(state, monkeypatch):
    """The caller logs it; otherwise the log would stay open, and no one would know."""
    calls = LogCalls(state, LogLimits(), {})
    calls.prepare(("talker", 1))

    def fails(_keeper: LogKeeper, _instance: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(LogKeeper, "release", fails)
    with pytest.raises(OSError, match="Input/output error"):
        calls.release(("talker", 1))
