"""Artifacts of migrations by criu on a slave: repeated steps, and cleanup."""

from __future__ import annotations

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
    """Offered images at once, fetched ones later; an instance that runs keeps its image."""
    later = []
    monkeypatch.setattr(artifacts, "_later", lambda *call: later.append(call))
    for place in (outgoing(tmp_path, 1), incoming(tmp_path, 2), incoming(tmp_path, 3)):
        place.mkdir(parents=True)
        (place / "manifest.json").touch()
    artifacts.sweep(tmp_path, ["p#3"])
    assert not outgoing(tmp_path, 1).exists()
    assert [directory for _, _, directory in later] == [incoming(tmp_path, 2)]
    for _, do, directory in later:
        do(directory)
    assert not incoming(tmp_path, 2).exists()
    assert incoming(tmp_path, 3).exists()


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
