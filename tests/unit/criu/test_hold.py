"""What the program that holds a restored process does when it is started again: real processes.

None of them comes so far as to need CRIU; what does is in tests/integration/criu/test_hold.py.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rosrm_criu.engine import image, restore_result
from rosrm_criu.engine.restore_result import Outcome

#: A plain restore that failed, as `hold.FAILED`.
FAILED = 125


@pytest.fixture
def directory(tmp_path):
    """An image that is none: its files have nothing in them."""
    image.create(tmp_path / "in-7")
    (tmp_path / "in-7" / image.MANIFEST).write_text("{")
    (tmp_path / "in-7" / image.PAGES / "pages-1.img").write_text("memory")
    return tmp_path / "in-7"


def start(directory: Path, *then: str, remove: bool = True) -> subprocess.CompletedProcess[str]:
    """As the supervisor starts it, at first and after each crash."""
    command = restore_result.command(
        sys.executable, directory, criu=Path("/none"), remove=remove, timeout=5.0, then=then
    )
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_after_a_life_that_was_restored_the_process_begins_anew(directory):
    """What an earlier life told stays; a memory that a SIGKILL left on the disk goes."""
    told = Outcome(pid=7, inner_pid=7)
    restore_result.write(directory, told)
    for _ in range(2):
        assert start(directory, "echo", "anew").stdout == "anew\n"
        assert restore_result.read(directory) == told
        assert [path.name for path in directory.iterdir()] == [restore_result.FILE]


def test_without_an_image_nothing_begins_anew(tmp_path):
    """Whoever has removed it, what it held is lost, or goes on elsewhere: that is no second one."""
    ended = start(tmp_path / "in-7", "echo", "anew")
    assert (ended.returncode, ended.stdout) == (FAILED, "")
    assert "holds no complete image" in ended.stderr


@pytest.mark.parametrize("told", [None, Outcome(reason="no room")])
def test_a_restore_that_never_worked_does_not_begin_anew(directory, told):
    """It fails, and says why, as often as it is started."""
    if told is not None:
        restore_result.write(directory, told)
    for _ in range(2):
        ended = start(directory, "echo", "anew")
        assert (ended.returncode, ended.stdout) == (FAILED, "")
        assert "damaged" in restore_result.read(directory).reason


def test_an_image_without_a_command_is_for_one_life_too(directory):
    """Nothing else can be started; it stays known that the image was used up."""
    told = Outcome(pid=7, inner_pid=7)
    restore_result.write(directory, told)
    ended = start(directory)
    assert ended.returncode == FAILED
    assert "was restored before" in ended.stderr
    assert restore_result.read(directory) == told
