"""Periodic images: the valid one, the number of its uses, and the start without an image."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import restart_from_image, slots
from rosrm_criu.engine.slots import Rejoin

REJOIN = Rejoin("/tmp/rosrm-0/portable/x", "p#1-periodic-1", 0)


@pytest.fixture
def parent(tmp_path):
    return tmp_path / "periodic-1"


def image(parent):
    """Create an image that is dumped but not valid yet."""
    slot = slots.new_slot(parent)
    slot.mkdir(parents=True)
    (slot / "manifest.json").write_text("{}")
    return slot


def test_the_newest_complete_image_counts(parent):
    """An image under way is not used; a complete image replaces the previous one."""
    assert slots.newest(parent) is None
    first = image(parent)
    assert slots.newest(parent) is None
    slots.complete(first, REJOIN)
    second = image(parent)
    assert slots.newest(parent) == (first, REJOIN)
    slots.complete(second, REJOIN)
    assert slots.newest(parent) == (second, REJOIN)
    assert not first.exists()


def test_an_image_is_on_the_disk_before_the_earlier_one_is_removed(parent, monkeypatch):
    first, second = image(parent), image(parent.parent / "other")
    slots.complete(first, REJOIN)
    second = second.rename(parent / "2")
    is_there, forced = [], os.fsync

    def fsync(file):
        forced(file)
        is_there.append((Path(f"/proc/self/fd/{file}").readlink().name, first.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    slots.complete(second, REJOIN)
    names = {"manifest.json", "rejoin.json.new", "2", parent.name}
    assert names <= {name for name, is_first in is_there if is_first}
    assert not first.exists()


def test_an_image_is_started_from_twice_at_most(parent):
    """A process that keeps crashing starts without its image, until there is a newer image."""
    slot = image(parent)
    slots.complete(slot, REJOIN)
    for is_used in (True, True, False):
        assert (slots.newest(parent) is not None) is is_used
        slots.count_start(slot)
    newer = image(parent)
    slots.complete(newer, REJOIN)
    assert slots.newest(parent) == (newer, REJOIN)


def test_what_a_dump_has_left_goes(parent):
    """The rest of a dump is removed, and the valid image stays."""
    whole = image(parent)
    slots.complete(whole, REJOIN)
    torn = image(parent)
    slots.discard_unfinished(parent)
    assert (whole.exists(), torn.exists()) == (True, False)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"control": "/x"}'])
def test_a_damaged_one_is_named(parent, content):
    """An image without readable rejoin parameters is refused."""
    slot = image(parent)
    (slot / "rejoin.json").write_text(content)
    with pytest.raises(CriuError, match="is damaged: rejoin"):
        slots.newest(parent)


def test_a_start_without_image_happens_once(parent):
    """All images are removed once, including one completed since; later ones are used."""
    slot = image(parent)
    slots.start_without_image(parent)
    slots.complete(slot, REJOIN)
    assert slots.newest(parent) is None
    assert not parent.exists()
    later = image(parent)
    slots.complete(later, REJOIN)
    assert slots.newest(parent) == (later, REJOIN)


def test_images_that_cannot_be_removed_are_never_used(parent, monkeypatch):
    """The process starts from the beginning each time until they are removed."""
    slot = image(parent)
    slots.complete(slot, REJOIN)
    slots.start_without_image(parent)
    remove = slots.shutil.rmtree

    def refuse(path, **_):
        if path == parent:  # in any order
            (parent / "anew").unlink()

    monkeypatch.setattr(slots.shutil, "rmtree", refuse)
    assert [slots.newest(parent) for _ in range(2)] == [None, None]
    monkeypatch.setattr(slots.shutil, "rmtree", remove)
    assert slots.newest(parent) is None
    assert not parent.exists()


def test_numbers_grow(parent):
    """Images are ordered by number: the tenth is newer than the ninth."""
    for _ in range(10):
        slot = image(parent)
        slots.complete(slot, REJOIN)
    assert slot.name == "10"
    assert slots.newest(parent) == (slot, REJOIN)


# --- the program that starts a process ----------------------------------------------------------


def start(parent, *then):
    words = restart_from_image.command(
        sys.executable, parent, then, criu=parent / "criu", timeout=5.0
    )
    return subprocess.run(words, check=False, capture_output=True, text=True, timeout=60)


def test_without_an_image_it_is_the_process_itself(parent):
    """Without an image, the process runs with its own exit code and Python's default signals."""
    program = (
        "import os, signal, sys\n"
        "print(signal.getsignal(signal.SIGINT), os.environ['HOME'])\nsys.exit(7)"
    )
    done = start(parent, sys.executable, "-c", program)
    assert done.returncode == 7
    assert "default_int_handler" in done.stdout
    assert done.stderr == ""


def test_sigpipe_ends_it_as_ever(parent):
    """SIGPIPE ends the process, although Python ignores it and execve keeps ignored signals."""
    done = start(parent, "sh", "-c", "kill -PIPE $$; echo continued")
    assert (done.returncode, done.stdout) == (-13, "")


def test_a_damaged_image_is_logged_and_the_process_starts_without_it(parent):
    """A damaged image is logged, and the process starts without it."""
    slot = image(parent)
    (slot / "rejoin.json").write_text("{")
    done = start(parent, "echo", "started")
    assert (done.returncode, done.stdout) == (0, "started\n")
    assert "not started from its periodic image, but without it" in done.stderr


def test_a_program_that_is_missing_is_named(parent):
    """A missing program is named in the log, and the exit code is 1."""
    done = start(parent, "/nonesuch")
    assert (done.returncode, done.stderr) == (
        1, "/nonesuch cannot be started: No such file or directory\n",
    )  # fmt: skip


def test_it_asks_the_node_to_join_before_it_is_restored(parent, tmp_path):
    """The request to rejoin is written before the shim runs, which then fails without CRIU."""
    control = tmp_path / "control"
    slot = image(parent)
    slots.complete(slot, Rejoin(str(control), "p#1-periodic-1", os.geteuid()))
    done = start(parent, "echo", "started")
    assert done.returncode == 125
    assert "not restored" in done.stderr
    request = json.loads((control / "request").read_text())
    assert (request["id"], request["want"]) == ("p#1-periodic-1", "join")
    assert start(parent, "echo", "started").returncode == 125
    assert start(parent, "echo", "started").stdout == "started\n"
