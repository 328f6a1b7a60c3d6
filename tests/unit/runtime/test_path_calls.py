"""Calls on paths of users in threads: a late call delays neither the loop nor other calls."""

from __future__ import annotations

import queue
import threading

import pytest

from rosrm.runtime import path_calls
from rosrm.runtime.path_calls import NoAnswer, PathCalls
from tests.waiting import PATIENCE, wait_until


class Loop:
    """A loop with calls of which some wait until `answer` is set."""

    def __init__(self) -> None:
        self.now = 0.0
        self.posted: queue.Queue = queue.Queue()
        self.done: list[object] = []
        self.answer = threading.Event()
        self.waiting = threading.Semaphore(0)
        self.calls = PathCalls("test", self.posted.put, clock=lambda: self.now)

    def run(self, path: str, *, waits: bool = False) -> None:
        self.calls.run(lambda: self._work(path, waits), self.done.append, self.done.append)

    def _work(self, path: str, waits: bool) -> str:
        path_calls.at(path)
        if waits:
            self.waiting.release()
            self.answer.wait(PATIENCE)
        return path

    def turn(self) -> None:
        """Run one posted call."""
        self.posted.get(timeout=PATIENCE)()

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.calls.look()


@pytest.fixture
def loop():
    made = Loop()
    yield made
    made.answer.set()


def test_results_and_errors_return_to_the_loop(loop):
    """The thread continues after an error."""
    fault = ValueError("x")
    loop.calls.run(lambda: (_ for _ in ()).throw(fault), loop.done.append, loop.done.append)
    loop.run("/a")
    loop.turn()
    loop.turn()
    assert loop.done == [fault, "/a"]


def test_calls_behind_a_late_one_get_another_thread(loop):
    """The late one fails with its path; its answer, when it comes, is ignored."""
    loop.run("/late", waits=True)
    loop.run("/next")
    assert loop.waiting.acquire(timeout=PATIENCE)
    loop.pass_time(path_calls.LATE * 2)
    loop.turn()
    assert loop.done == ["/next"]
    loop.pass_time(path_calls.PATIENCE)
    assert str(loop.done[1]) == "/late does not answer (10 s)"
    loop.answer.set()
    loop.turn()
    loop.run("/again")
    loop.turn()
    assert loop.done[2:] == ["/again"]


def test_a_dead_mount_holds_up_one_thread(loop, monkeypatch):
    """Other paths on it are refused without being touched; paths elsewhere are used."""
    monkeypatch.setattr(path_calls, "_remote_mount", lambda path: path[:4].replace("/usr", ""))
    loop.run("/nfs/a", waits=True)
    assert loop.waiting.acquire(timeout=PATIENCE)
    loop.pass_time(path_calls.LATE * 2)
    loop.run("/nfs/b", waits=True)
    loop.run("/usr/c")
    loop.turn()
    loop.turn()
    assert isinstance(loop.done[0], NoAnswer)
    assert "nor does any other path on /nfs" in str(loop.done[0])
    assert loop.done[1] == "/usr/c"


def test_the_number_of_late_calls_is_bounded(loop, monkeypatch):
    """A call beyond the bound is refused at once; the reason names some of the paths."""
    monkeypatch.setattr(path_calls, "MOST_LATE", 2)
    for number in range(2):
        loop.run(f"/{number}", waits=True)
        assert loop.waiting.acquire(timeout=PATIENCE)
        loop.pass_time(path_calls.LATE * 2)
    before = threading.active_count()
    loop.run("/another")
    loop.turn()
    assert "calls wait for paths without an answer" in str(loop.done[0])
    assert threading.active_count() == before
    loop.answer.set()
    wait_until(lambda: threading.active_count() == before - 2, "the end of the late threads")


def test_mounts_of_other_machines_are_told_by_their_type(tmp_path):
    """A late path on a local file system blocks no other path there, unlike on a remote mount."""
    assert path_calls._remote_mount(str(tmp_path)) == ""
    assert path_calls._remote_mount("/proc/self") == ""


def test_the_newest_value_is_written_when_a_late_path_answers(loop):
    """The newest value is written although no later one follows; older ones are skipped."""
    written: list[str] = []

    def write(value: str) -> None:
        written.append(loop._work(value, waits=value == "first"))

    writes = path_calls.NewestWrite(loop.calls.run, write)
    writes.put("first")
    assert loop.waiting.acquire(timeout=PATIENCE)
    loop.pass_time(path_calls.LATE * 2)
    loop.pass_time(path_calls.PATIENCE)
    writes.put("second")
    writes.put("third")
    loop.answer.set()
    loop.turn()
    loop.turn()
    assert written == ["first", "third"]
