"""Calls on paths that users name, in threads: a path that does not answer blocks no loop.

On a file system that does not answer (a dead NFS server), an `open` or `stat` waits without a
limit, and no signal ends it. So a loop hands such calls to a thread. The thread names each path
before it touches the path (`at`). A call that is late keeps its thread, and the next calls get
another one. After `PATIENCE` the loop gets a `NoAnswer`.

The number of late calls is bounded. One dead mount does not use up this bound, because no further
call touches a network file system on which a late call waits.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, Generic, Protocol, TypeVar

from rosrm import clocks, threads
from rosrm.errors import RosrmError

#: Seconds for a call.
PATIENCE: Final = 10.0
#: Seconds after which the calls behind another one get a thread of their own.
LATE: Final = 0.2
#: Maximum number of late calls.
MOST_LATE: Final = 64
#: Types of file systems that need another machine or program for an answer.
_REMOTE: Final = (
    "nfs", "cifs", "smb", "fuse", "9p", "ceph", "afs", "autofs", "glusterfs", "lustre", "virtiofs",
)  # fmt: skip

_this_thread = threading.local()

T = TypeVar("T")


class NoAnswer(RosrmError):
    """A path does not answer."""


def at(path: str | os.PathLike[str]) -> None:
    """Note the path that this thread is about to touch; outside of a `PathCalls` do nothing.

    Raises:
        NoAnswer: it is on a network file system that does not answer to another call.
    """
    call = getattr(_this_thread, "call", None)
    if call is not None:
        call.reach(str(Path(path).absolute()))


class PathCall:
    """A call, and the path that it is about to touch.

    Attributes:
        has_ended: no thread executes it any more, or will.
        ended_late: called in the loop at the end of a call that has failed as late.
    """

    def __init__(
        self, work: Callable[[], Any], then: Callable[[Any], None],
        failed: Callable[[Exception], None], late: Callable[[], None],
        others: Callable[[], list[PathCall]],
    ) -> None:  # fmt: skip
        self.work, self.then, self.failed, self.late = work, then, failed, late
        self._others = others
        self.path = ""
        self.began = 0.0
        self.is_over = False
        self.has_ended = False
        self.ended_late: Callable[[], None] = lambda: None

    def reach(self, path: str) -> None:
        """Note the path; raise `NoAnswer` if it is on a file system with a late call."""
        others = [one for one in self._others() if one is not self]
        mount = _remote_mount(path) if others else ""
        if mount and any(_remote_mount(one.path) == mount for one in others):
            raise NoAnswer(f"{path} does not answer, nor does any other path on {mount}")
        self.path = path


class _Lane:
    """A thread, its current call, and the calls behind it."""

    def __init__(
        self, name: str, clock: Callable[[], float], finish: Callable[[PathCall, Any], None]
    ) -> None:
        self.calls: SimpleQueue[PathCall | None] = SimpleQueue()
        self.current: PathCall | None = None
        self._clock, self._finish = clock, finish
        threads.start(self._work, name, again=True)

    def _work(self) -> None:
        while (call := self.calls.get()) is not None:
            call.began = self._clock()
            self.current = _this_thread.call = call
            try:
                outcome = partial(call.then, call.work())
            except Exception as error:  # noqa: BLE001 - the loop handles it, and the thread lives on
                outcome = partial(call.failed, error)
            self.current = None
            call.has_ended = True
            self._finish(call, outcome)


class PathCalls:
    """Threads for calls on paths that users name; the first one begins with the first call.

    Args:
        name: of the threads.
        post: schedules a call in the loop; may be called from any thread.
        clock: monotonic seconds.
    """

    def __init__(
        self, name: str, post: Callable[[Callable[[], None]], None], *,
        clock: Callable[[], float] = clocks.awake_time,
    ) -> None:  # fmt: skip
        self._name, self._post, self._clock = name, post, clock
        self._lane: _Lane | None = None
        self._late: list[_Lane] = []

    def run(
        self, work: Callable[[], Any], then: Callable[[Any], None],
        failed: Callable[[Exception], None], late: Callable[[], None] = lambda: None,
    ) -> PathCall:  # fmt: skip
        """Call `work` in a thread, then in the loop `then` with its result.

        If `work` raises, or is not over in time (`NoAnswer`), `failed` is called in the loop with
        the exception. Before that, `late` is called in the loop if the call takes a while.
        """
        call = PathCall(work, then, failed, late, self._late_calls)
        self._put(call)
        return call

    def look(self) -> None:
        """Find the calls that are late; the loop calls this several times a second."""
        now = self._clock()
        lane = self._lane
        call = None if lane is None else lane.current
        if lane is not None and call is not None and now - call.began > LATE:
            self._late.append(lane)
            self._lane = None
            for behind in _taken(lane.calls):
                self._put(behind)
            lane.calls.put(None)
            call.late()
        self._late = [one for one in self._late if one.current is not None]
        for call in self._late_calls():
            if not call.is_over and now - call.began > PATIENCE:
                call.is_over = True
                call.failed(NoAnswer(f"{call.path or 'it'} does not answer ({PATIENCE:g} s)"))

    def _put(self, call: PathCall) -> None:
        if len(self._late) >= MOST_LATE:
            paths = sorted({one.path for one in self._late_calls()})[:3]
            fault = NoAnswer(f"{MOST_LATE} calls wait for paths without an answer, e.g. {paths}")
            call.has_ended = True
            self._post(partial(call.failed, fault))
            return
        if self._lane is None:
            try:
                self._lane = _Lane(self._name, self._clock, self._finish)
            except RuntimeError as error:  # no thread can be started
                call.has_ended = True
                self._post(partial(call.failed, error))
                return
        self._lane.calls.put(call)

    def _late_calls(self) -> list[PathCall]:
        return [call for lane in tuple(self._late) if (call := lane.current) is not None]

    def _finish(self, call: PathCall, outcome: Callable[[], None]) -> None:
        """Return an outcome to the loop, in the thread of the call."""
        self._post(lambda: call.ended_late() if call.is_over else outcome())


class RunPath(Protocol):
    """Signature of `PathCalls.run`."""

    def __call__(
        self, work: Callable[[], Any], then: Callable[[Any], None],
        failed: Callable[[Exception], None],
    ) -> PathCall:  # fmt: skip
        """Call `work` in a thread, see `PathCalls.run`."""


def run_at_once(
    work: Callable[[], Any], then: Callable[[Any], None], failed: Callable[[Exception], None]
) -> PathCall:
    """Call `work` in this thread, for a caller without a loop; see `PathCalls.run`."""
    call = PathCall(work, then, failed, lambda: None, list)
    call.has_ended = True
    try:
        outcome = work()
    except Exception as error:  # noqa: BLE001 - as in a thread
        failed(error)
    else:
        then(outcome)
    return call


class NewestWrite(Generic[T]):
    """Writes the newest of some values; while the path does not answer, a value replaces the last.

    A failed write is not repeated.

    Args:
        run: as `PathCalls.run`.
        write: writes a value, in a thread.
    """

    def __init__(self, run: RunPath, write: Callable[[T], None]) -> None:
        self._run, self._write = run, write
        self._values: list[T] = []
        self._call: PathCall | None = None

    def put(self, value: T) -> None:
        """Write a value, now or when the path answers."""
        self._values[:] = [value]
        self._begin()

    def _begin(self) -> None:
        if self._values and (self._call is None or self._call.has_ended):
            write = partial(self._write, self._values.pop())
            self._call = self._run(write, self._continue, self._continue)
            self._call.ended_late = self._begin

    def _continue(self, _: object) -> None:
        self._begin()


def _taken(calls: SimpleQueue[PathCall | None]) -> list[PathCall]:
    taken: list[PathCall] = []
    while True:
        try:
            call = calls.get_nowait()
        except Empty:
            return taken
        if call is not None:
            taken.append(call)


def _remote_mount(path: str) -> str:
    """Return the mount point of a path, without touching it; "": it needs no other machine."""
    longest, kind = "", ""
    for line in Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines():
        mounted, _, about = line.partition(" - ")
        point = mounted.split(" ")[4].encode().decode("unicode_escape")
        if len(point) >= len(longest) and (path + "/").startswith(point.rstrip("/") + "/"):
            longest, kind = point, about.split(" ")[0]
    return longest if kind.startswith(_REMOTE) else ""
