"""Watch of the disk of the state directory."""

from __future__ import annotations

import subprocess

from rosrm.slave.state_disk import fault_of
from tests.faults.disks import small_disk


def test_a_full_and_a_read_only_disk_are_faults(tmp_path):
    """The watch reports both faults, and leaves no file behind."""
    with small_disk(tmp_path / "disk") as disk:
        assert fault_of(disk.place) == ""
        assert not any(disk.place.iterdir())
        disk.fill()
        assert "No space left" in fault_of(disk.place)
        disk.make_room()
        assert fault_of(disk.place) == ""
        subprocess.run(["mount", "-o", "remount,ro", disk.place], check=True)
        assert "Read-only" in fault_of(disk.place)


def test_a_directory_that_is_gone_is_no_fault_of_its_disk(tmp_path):
    """The parts that use a missing directory report that, so the watch of the disk does not."""
    assert fault_of(tmp_path / "gone") == ""
