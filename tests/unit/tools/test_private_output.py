"""Files of the tools: only the user of the command may read them, whatever the umask is."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from rosrm.keys import key_files
from rosrm.keys.cluster import PrincipalKey
from rosrm.keys.roles import Grant, Role, principal_of
from rosrm_alerts.outbox import Outbox, OutboxError
from rosrm_report.writing import write_page
from tests.unit.tools.report.runs import report


@pytest.fixture(autouse=True)
def no_umask():
    """Create all files as an absent-minded system service would."""
    former = os.umask(0)
    yield
    os.umask(former)


def modes_below(directory: Path) -> dict[str, int]:
    """Return the rights of group and others on each file."""
    return {
        str(path.relative_to(directory)): stat.S_IMODE(path.lstat().st_mode) & 0o077
        for path in directory.rglob("*")
    }


def test_the_outbox_of_alerts_is_private(tmp_path):
    """The journal and the directories are private, too; an older file is tightened."""
    box = Outbox(tmp_path / "state" / "outbox")
    box.commit([], 7, {})
    box.close()
    assert set(modes_below(tmp_path).values()) == {0}
    (tmp_path / "old").touch(0o644)
    Outbox(tmp_path / "old").close()
    assert modes_below(tmp_path)["old"] == 0


def test_an_outbox_that_is_a_fifo_is_refused(tmp_path):
    """An outbox that is a FIFO is refused, because opening it would block for ever."""
    os.mkfifo(tmp_path / "outbox")
    with pytest.raises(OutboxError, match="no regular file"):
        Outbox(tmp_path / "outbox")


def test_a_report_is_private(tmp_path):
    """A report may have lines of logs; an older file of other rights is replaced."""
    output = tmp_path / "report.html"
    output.touch(0o644)
    write_page(report(), output)
    assert modes_below(tmp_path) == {"report.html": 0}


def test_a_key_is_written_beside_no_fifo(tmp_path):
    """A FIFO of another user under the temporary name does not get the key."""
    os.mkfifo(tmp_path / "robot.key.new")
    key = PrincipalKey(Grant(principal_of("host:robot"), Role.HOST, 1), bytes(32), bytes(32))
    with pytest.raises(Exception, match="no regular file"):
        key_files.write_key(tmp_path / "robot.key", key)
    (tmp_path / "robot.key.new").unlink()
    key_files.write_key(tmp_path / "robot.key", key)
    assert modes_below(tmp_path) == {"robot.key": 0}
