"""Artifacts of migrations by criu on a slave: repeated steps, and cleanup."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import image, restore_result
from rosrm_criu.engine.paths import incoming, outgoing
from rosrm_criu.engine.restore_result import Outcome
from rosrm_criu.executors import artifacts, attempts

PATIENCE = 20.0
_numbers = count()


@pytest.fixture
def attempt():
    """Return the id of an attempt that no other test uses."""
    return f"p#1-{next(_numbers)}"


def test_a_repeated_step_runs_once(attempt):
    """Calls during the step and later ones get the answer of the first one."""
    begun, may_end, done = threading.Event(), threading.Event(), []

    def work():
        begun.set()
        assert may_end.wait(PATIENCE)
        done.append(1)
        return {"n": len(done)}

    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(attempts.once, "step", attempt, work)
        assert begun.wait(PATIENCE)
        second = threads.submit(attempts.once, "step", attempt, work)
        may_end.set()
        assert first.result(PATIENCE) == second.result(PATIENCE) == {"n": 1}
    assert attempts.once("step", attempt, work) == {"n": 1}
    assert attempts.once("other step", attempt, work) == {"n": 2}


def test_a_failed_step_runs_again(attempt):
    def fails():
        raise CriuError("no room")

    with pytest.raises(CriuError, match="no room"):
        attempts.once("step", attempt, fails)
    attempts.after("step", attempt, 0.0)  # it has ended
    assert attempts.once("step", attempt, dict) == {}


def test_the_wait_for_a_step_has_a_timeout(attempt):
    begun, may_end = threading.Event(), threading.Event()

    def work():
        begun.set()
        assert may_end.wait(PATIENCE)
        raise CriuError("it failed in the end")

    with ThreadPoolExecutor(1) as threads:
        going = threads.submit(attempts.once, "step", attempt, work)
        assert begun.wait(PATIENCE)
        with pytest.raises(CriuError, match=r"still under way after 0\.01 s"):
            attempts.after("step", attempt, 0.01)
        may_end.set()
        attempts.after("step", attempt, PATIENCE)  # its error is for the caller of the step
        with pytest.raises(CriuError, match="in the end"):
            going.result(PATIENCE)


def test_remains_of_a_former_slave_are_removed(tmp_path, monkeypatch):
    """Offered images at once, fetched ones later, also that of an instance that may end since."""
    later = []
    monkeypatch.setattr(artifacts, "call_later", lambda *call: later.append(call))
    for place in (outgoing(tmp_path, 1), incoming(tmp_path, 2), incoming(tmp_path, 3)):
        place.mkdir(parents=True)
        (place / "manifest.json").touch()
    artifacts.sweep(tmp_path, ["p#3"])
    assert not outgoing(tmp_path, 1).exists()
    fetched = [incoming(tmp_path, 2), incoming(tmp_path, 3)]
    assert sorted(directory for _, _, directory, _ in later) == fetched
    for _, do, *arguments in later:
        do(*arguments)
    assert not any(directory.exists() for directory in fetched)


def test_an_image_is_not_removed_while_it_is_restored(tmp_path, monkeypatch):
    """A large image takes longer than a slave keeps the rest of its predecessor."""
    later = []
    monkeypatch.setattr(artifacts, "call_later", lambda *call: later.append(call))
    directory = incoming(tmp_path, 1)
    directory.mkdir(parents=True)
    words = [sys.executable, "-c", "input()", str(directory)]
    with subprocess.Popen(words, stdin=subprocess.PIPE) as shim:
        artifacts.remove_unused_later(directory, 1.0)
        _, do, *arguments = later.pop()
        do(*arguments)
        assert directory.exists()
        shim.kill()
    _, do, *arguments = later.pop()
    do(*arguments)
    assert not directory.exists()


@pytest.mark.parametrize(("reason", "known"), [("", True), ("the image is damaged", False)])
def test_an_unused_image_is_removed_and_the_result_of_a_restore_stays(tmp_path, reason, known):
    """The shim may have been killed before it removed the image."""
    directory = incoming(tmp_path, 1)
    directory.mkdir(parents=True)
    (directory / image.MANIFEST).write_text("{}")
    restore_result.write(directory, Outcome(reason=reason, pid=7))
    artifacts.remove_unused(directory)
    assert restore_result.was_restored(directory) is known
    assert not (directory / image.MANIFEST).exists()
