"""Parts of a log: what was asked for, across rotations, and a reason where there is none."""

from __future__ import annotations

import pytest

from rosrm.core.model import InstanceId
from rosrm.errors import Refused
from rosrm.slave.log_reading import newest_instance, read_log
from rosrm.supervisor.client import LogLimits, log_path
from rosrm.supervisor.logs import rotate

P = InstanceId("robot/p", 3)


@pytest.fixture
def log(tmp_path):
    path = log_path(tmp_path, P)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"0123456789")
    return path


def read(tmp_path, offset=0, most=0, *, ended=False):
    return read_log(tmp_path, P, offset, most, ended=ended)


@pytest.mark.parametrize(
    ("offset", "most", "content", "after"),
    [
        (0, 0, b"0123456789", 10),
        (0, 4, b"0123", 4),
        (4, 4, b"4567", 8),
        (8, 4, b"89", 10),
        (10, 4, b"", 10),
        (-3, 0, b"789", 10),
        (-3, 2, b"78", 9),
        (-99, 0, b"0123456789", 10),
    ],
)
def test_parts(tmp_path, log, offset, most, content, after) -> None:
    """From an offset, or from the end; the next offset continues without gap or repetition."""
    part = read(tmp_path, offset, most)
    assert (part.content, part.next_offset) == (content, after)


def test_ended_only_with_everything_read(tmp_path, log) -> None:
    """Whoever follows reads on until the last byte, and is then told that nothing more comes."""
    assert not read(tmp_path, 0, 4, ended=True).ended
    assert read(tmp_path, 4, ended=True).ended
    assert not read(tmp_path, 4, ended=False).ended


def test_what_is_appended_is_read_on(tmp_path, log) -> None:
    """Following reads only what is new."""
    first = read(tmp_path)
    log.write_bytes(log.read_bytes() + b"ab")
    assert read(tmp_path, first.next_offset).content == b"ab"
    assert read(tmp_path, first.next_offset).generation == first.generation


@pytest.mark.parametrize("keep", [0, 1, 2])
def test_a_rotation_is_noticed(tmp_path, log, keep) -> None:
    """The log was cut meanwhile: the generation changes, or the part begins at its start again."""
    first = read(tmp_path)
    rotate(str(log), 10, LogLimits(max_bytes=5, keep=keep))
    log.write_bytes(b"new")
    second = read(tmp_path, first.next_offset)
    if keep:
        assert second.generation != first.generation
        assert read(tmp_path, 0).content == b"new"
    else:
        assert second.content == b"new"


def test_one_answer_is_bounded(tmp_path, log) -> None:
    """Whatever is asked for, a flood does not come in one message."""
    log.write_bytes(b"x" * (3 << 20))
    assert len(read(tmp_path, most=0).content) == len(read(tmp_path, most=2**32 - 1).content)
    assert len(read(tmp_path).content) <= 1 << 20


def test_no_log_is_said(tmp_path) -> None:
    """With the file that was looked for."""
    with pytest.raises(Refused, match="no log of robot/p#3"):
        read(tmp_path)
    with pytest.raises(Refused, match="no log of nobody"):
        newest_instance(tmp_path, "nobody")


def test_newest_instance(tmp_path, log) -> None:
    """By number, not by name: 10 is newer than 9; rotated and other files do not count."""
    for number in (9, 10):
        log_path(tmp_path, InstanceId("robot/p", number)).write_bytes(b"")
    for process in ("robot", "robot/p.11", "p", "robot/p/12"):
        log_path(tmp_path, InstanceId(process, 99)).write_bytes(b"")
    for suffix in (".1", ".parameters.yaml"):
        path = log_path(tmp_path, InstanceId("robot/p", 11))
        path.with_name(path.name + suffix).write_bytes(b"")
    assert newest_instance(tmp_path, "robot/p") == InstanceId("robot/p", 10)
