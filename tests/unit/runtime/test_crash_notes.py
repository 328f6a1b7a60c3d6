"""Notes of the calls of plugins: which plugin a process called when it ended."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.runtime.crash_notes import CrashNotes, kept_notes

#: A process that ends within a call, in the way of the last argument.
PROGRAM = """
import ctypes, os, sys, threading
from pathlib import Path
from rosrm.extensions.guard import guarded, note_versions
from rosrm.runtime.crash_notes import kept_notes

def other():
    guarded(threading.Event().wait, whom="probe 'slow'", hook="read")
def wait():
    print("ready", flush=True)
    sys.stdin.read()
ways = {"exit": lambda: os._exit(3), "crash": lambda: ctypes.string_at(0), "wait": wait}
with kept_notes(Path(sys.argv[1])):
    note_versions({"filter 'odd'": "odd 1.0"})
    threading.Thread(target=other, daemon=True).start()
    try:
        guarded(ways.get(sys.argv[2], int), whom="filter 'odd'", hook="mask", seconds=60.0)
    except Exception as refused:
        print(refused)
"""


def _run(directory: Path, way: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, directory, way],
        input="", capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    return done.stdout


def _kill(directory: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, directory, "wait"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.kill()


@pytest.mark.parametrize(("way", "how"), [("exit", "by os._exit"), ("crash", "by a crash")])
def test_a_plugin_that_ends_its_process_is_named_and_then_left_out(
    tmp_path: Path, way: str, how: str
) -> None:
    """The second start does not call it any more; a plugin that ran beside it is not blamed."""
    for _ in range(2):
        _run(tmp_path, way)
    notes = CrashNotes(tmp_path)
    notes.close()
    assert [one.whom for one in notes.found] == ["filter 'odd'"]
    assert how in notes.found[0].text
    assert notes.reason("probe 'slow'", "read") == ""
    assert "this process ended" in _run(tmp_path, way)


def test_a_plugin_of_another_version_is_tried_again(tmp_path: Path) -> None:
    """A new version of its distribution may have fixed the fault."""
    for _ in range(2):
        _run(tmp_path, "exit")
    notes = CrashNotes(tmp_path)
    notes.note_versions({"filter 'odd'": "odd 1.0"})
    assert notes.reason("filter 'odd'", "mask")
    assert not notes.reason("filter 'odd'", "create")
    notes.note_versions({"filter 'odd'": "odd 1.1"})
    assert not notes.reason("filter 'odd'", "mask")
    notes.close()


def test_a_full_disk_forgets_no_plugin(tmp_path: Path) -> None:
    """Stored weights stay, and the next start with room stores the newest end."""
    for _ in range(2):
        _run(tmp_path, "exit")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))  # no file takes a byte
    try:
        with kept_notes(tmp_path):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    notes = CrashNotes(tmp_path)
    notes.close()
    assert "this process ended" in notes.reason("filter 'odd'", "mask")


def test_a_kill_from_outside_is_no_proof(tmp_path: Path) -> None:
    """After two kills the plugin that was running is named, but it is still called."""
    for _ in range(2):
        _kill(tmp_path)
    notes = CrashNotes(tmp_path)
    notes.close()
    assert "filter 'odd'" in {one.whom for one in notes.found}
    assert _run(tmp_path, "none") == ""


def test_an_orderly_end_leaves_no_file(tmp_path: Path) -> None:
    """A part that ends in order leaves no file, and its next start names no plugin."""
    assert _run(tmp_path, "none") == ""
    assert list(tmp_path.glob("plugin-*")) == []
    with kept_notes(tmp_path) as crashes:
        assert crashes == ()


def test_a_forked_child_blames_nobody(tmp_path: Path) -> None:
    """A child of a plugin ends by `os._exit`, as those of multiprocessing do."""
    notes = CrashNotes(tmp_path)
    slot = notes.begin("probe 'p'", "read")
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    notes.end(slot)
    notes.close()
    again = CrashNotes(tmp_path)
    again.close()
    assert again.found == ()


def test_a_part_starts_where_no_notes_can_be_kept(tmp_path: Path) -> None:
    """A directory that takes no file, as on a full disk, keeps no part from starting."""
    (tmp_path / "file").write_text("")
    with kept_notes(tmp_path / "file") as crashes:
        assert crashes == ()
