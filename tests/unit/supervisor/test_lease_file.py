"""Last contact of the master with the host, stored for the next supervisor."""

from __future__ import annotations

from math import inf

import pytest

from rosrm.core.supervisor.events import ContactReported
from rosrm.runtime.file_thread import FileThread
from rosrm.supervisor import lease_file
from tests.limits import no_more_files
from tests.waiting import PATIENCE

DISK = FileThread("the state directory", patience=PATIENCE)


def test_the_newest_is_read_back(tmp_path):
    """The order in which the times arrived makes no difference."""
    kept = lease_file.LastContact(str(tmp_path), DISK)
    for at, alive in ((5.0, 1.0), (123456789.25, 3.0), (7.0, 2.0)):
        kept.keep(ContactReported(at, alive))
    DISK.ask(lambda: None)
    assert lease_file.read(str(tmp_path)) == ContactReported(123456789.25, 3.0)
    assert len((tmp_path / "heard").read_bytes().splitlines()) == 1


def test_a_contact_of_another_boot_does_not_count(tmp_path, monkeypatch):
    """The clock of another boot does not compare."""
    lease_file.LastContact(str(tmp_path), DISK).keep(ContactReported(5.0))
    DISK.ask(lambda: None)
    monkeypatch.setattr(lease_file.procfs, "boot_id", lambda: "another")
    assert lease_file.read(str(tmp_path)) == ContactReported(-inf, -inf)


@pytest.mark.parametrize("content", [None, b"", b"torn", b"\xff\xff \xff", b"boot not-a-number\n"])
def test_an_unreadable_lease_file_does_not_count(tmp_path, content):
    """Each instance's own start counts then, which fences it earlier."""
    if content is not None:
        (tmp_path / "heard").write_bytes(content)
    assert lease_file.read(str(tmp_path)) == ContactReported(-inf, -inf)


def test_a_lease_file_that_cannot_be_written_is_logged_once(tmp_path, capfd):
    """Fences then rely on the contacts known to this supervisor."""
    (tmp_path / "heard").mkdir()
    kept = lease_file.LastContact(str(tmp_path), DISK)
    for at in (5.0, 6.0):
        kept.keep(ContactReported(at))
        DISK.ask(lambda: None)
    assert capfd.readouterr().err.count("heard cannot be written: Is a directory") == 1


def test_a_lease_file_that_cannot_be_opened_now_is_not_left_out(tmp_path):
    """Older times would fence a process whose host is in contact; the supervisor starts again."""
    lease_file.LastContact(str(tmp_path), DISK).keep(ContactReported(5.0))
    DISK.ask(lambda: None)
    with no_more_files(), pytest.raises(OSError, match="Too many open files"):
        lease_file.read(str(tmp_path))
