"""Restarts of the shim, with real processes.

None of them needs CRIU; tests/integration/test_criu_images.py has those that do.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import image, process_tree, restore_result
from rosrm_criu.engine.restore_result import Outcome

#: Exit code of a failed restore, as `shim.FAILED`.
FAILED = 125


@pytest.fixture
def directory(tmp_path):
    """Return an invalid image, with an unreadable manifest."""
    image.create(tmp_path / "in-7")
    (tmp_path / "in-7" / image.MANIFEST).touch(mode=0o600)
    (tmp_path / "in-7" / image.MANIFEST).write_text("{")
    (tmp_path / "in-7" / image.PAGES / "pages-1.img").write_text("memory")
    return tmp_path / "in-7"


def start(directory: Path, *then: str, remove: bool = True) -> subprocess.CompletedProcess[str]:
    """Run the shim as the supervisor does, at first and after each crash."""
    command = restore_result.command(
        sys.executable, directory, criu=Path("/none"), remove=remove, timeout=5.0, then=then
    )
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_after_a_restored_process_has_ended_its_command_runs(directory):
    """A restart after a restore runs the command, keeps the result and removes leftover images."""
    outcome = Outcome(pid=7, inner_pid=7)
    restore_result.write(directory, outcome)
    for _ in range(2):
        assert start(directory, "echo", "started").stdout == "started\n"
        assert restore_result.read(directory) == outcome
        assert [path.name for path in directory.iterdir()] == [restore_result.FILE]


def test_a_result_that_is_nested_deeply_is_no_result(directory):
    (directory / restore_result.FILE).write_text("[" * 100_000)
    with pytest.raises(CriuError, match="is damaged"):
        restore_result.read(directory)
    assert not restore_result.was_restored(directory)


def test_without_an_image_no_command_runs(tmp_path):
    """A missing image fails the start, because its process is lost or may run elsewhere."""
    ended = start(tmp_path / "in-7", "echo", "started")
    assert (ended.returncode, ended.stdout) == (FAILED, "")
    assert "holds no complete image" in ended.stderr


@pytest.mark.parametrize("outcome", [None, Outcome(reason="no room")])
def test_after_a_failed_restore_no_command_runs(directory, outcome):
    """A failed restore fails with its reason at each start, and the command never runs."""
    if outcome is not None:
        restore_result.write(directory, outcome)
    for _ in range(2):
        ended = start(directory, "echo", "started")
        assert (ended.returncode, ended.stdout) == (FAILED, "")
        assert "damaged" in restore_result.read(directory).reason


def test_an_image_without_a_command_is_used_once(directory):
    """A used image without a command fails the start; the result of the restore stays."""
    outcome = Outcome(pid=7, inner_pid=7)
    restore_result.write(directory, outcome)
    ended = start(directory)
    assert ended.returncode == FAILED
    assert "was restored before" in ended.stderr
    assert restore_result.read(directory) == outcome


#: Restores a process that ends with 7, as a child of the shim.
_RESTORE = """
import os, signal, sys, time
from pathlib import Path
from rosrm_criu.engine import process_tree, shim

class Task:
    directory = Path(sys.argv[1])

    def run(self, marks):
        self.root = os.fork()
        if self.root == 0:
            time.sleep(0.3 if BRIEF else 60.0)
            os._exit(7)
        print(self.root, flush=True)
        return self.root

    def report(self, root, *, namespace):
        for child in process_tree.children(os.getpid()):
            if child != root:
                os.kill(child, signal.SIGKILL)
"""


def run(directory: Path, program: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", _RESTORE + program, str(directory)]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)


def test_the_exit_code_arrives_though_the_guard_was_killed(directory):
    ended = run(directory, "BRIEF = True\nshim._restore_as_child(Task())")
    assert ended.returncode == 7


def test_a_restored_process_without_a_guard_does_not_outlive_its_shim(directory):
    """The host may have no room for one process more; the image stays for another attempt."""
    refusing = """
BRIEF = False
def refused(root):
    raise BlockingIOError(11, "Resource temporarily unavailable")
shim._start_guard = refused
shim._restore_as_child(Task())
"""
    ended = run(directory, refusing)
    assert (ended.returncode, process_tree.is_alive(int(ended.stdout))) == (FAILED, False)
    assert "temporarily unavailable" in restore_result.read(directory).reason
