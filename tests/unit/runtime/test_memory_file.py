"""Files that need no disk, also where the kernel refuses files in memory."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from rosrm.ros.fast_dds import announcing_part, bound
from rosrm.runtime.memory_file import memory_file


def refuse(_name: str) -> int:
    raise OSError(errno.EPERM, "Operation not permitted")


def test_a_refused_memfd_becomes_a_file_without_a_name(monkeypatch):
    """A filter of system calls refuses `memfd_create`."""
    monkeypatch.setattr(os, "memfd_create", refuse)
    file = memory_file("x", b"content")
    with os.fdopen(file, "rb") as opened:
        assert opened.read() == b"content"


def test_profiles_of_participants_need_no_temporary_directory(monkeypatch, tmp_path):
    """A part joins ROS on a full and on a read-only disk."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    for context in (announcing_part({}, "steady"), bound({}, "steady", "lo")):
        with context:
            pass
    environment: dict[str, str] = {}
    with announcing_part(environment, "steady"):
        (path,) = [value for value in environment.values() if value.startswith("/")]
        # Fast DDS opens no other file.
        assert "<leaseDuration>" in Path(path).resolve(strict=True).read_text(encoding="utf-8")
