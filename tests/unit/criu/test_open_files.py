"""Open files of a process that follow it, tested with this process's own files."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from rosrm_criu.engine import image, open_files
from rosrm_criu.engine.image import HeldFile


@pytest.fixture
def directory(tmp_path):
    """Return the directory of an empty image."""
    image.create(tmp_path / "image")
    return tmp_path / "image"


def held(directory: Path, working_directory: object) -> dict[str, HeldFile]:
    """Return this process's open files by path."""
    found = open_files.open_files([os.getpid()], (), str(working_directory), directory)
    return {one.path: one for one in found}


def test_each_file_that_follows_has_a_copy_of_its_own(work, directory):
    """Each file has its own copy, even if a read-only descriptor of it was listed first."""
    (work / "a").write_text("of a")
    with contextlib.ExitStack() as files:
        for name, mode in (("a", "r"), ("a", "r+"), ("b", "w")):
            file = files.enter_context((work / name).open(mode))
            if name == "b":
                file.write("of b")
                file.flush()
        found = held(directory, work)
    for name in "ab":
        copy = found[str(work / name)].copy
        assert (directory / copy).read_text() == f"of {name}"


def test_nothing_follows_a_process_that_works_in_the_root_directory(work, directory):
    """A process in `/` takes no files along, because all files of the host lie below it."""
    with (work / "a").open("w"):
        assert held(directory, "/")[str(work / "a")].copy == ""
        assert held(directory, work)[str(work / "a")].copy
