"""Thread for the file calls of a loop: a directory that does not answer blocks no loop.

On a file system that does not answer (a dead NFS server, a failing disk), each call waits without
a limit. So the loop hands its calls on one directory to a thread, which executes them in order. The
loop waits for a result at most `LATE` seconds, and only once: until the late call has ended, it
does not wait again. The parts of the loop treat such a directory like a full disk.

The supervisor forks while such a thread runs. `os.fork` and `spawn_into` make new locks of the
interpreter in the child. The locks and queues of this module are those of `_thread` and `_queue`,
because `threading` loads 300 KiB.
"""

from __future__ import annotations

import _thread
import contextlib
import errno
import sys
from _queue import SimpleQueue
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Generic, TypeVar

from rosrm import clocks

#: Maximum time, in seconds, that the loop waits for a call.
LATE: Final = 1.0
#: Seconds after which a thread asks the loop for the lock of the interpreter.
_NEVER: Final = 1000.0

T = TypeVar("T")


def let_threads_wait() -> None:
    """Keep threads from requesting the interpreter's lock, in a process that calls `fork_into`.

    Otherwise a child of `fork_into`, which has no such thread, would wait for the thread for ever.
    The loop releases the lock in each wait for events.
    """
    sys.setswitchinterval(_NEVER)


class NoAnswer(OSError):
    """A directory does not answer, or not yet."""


class Call(Generic[T]):
    """A call that is queued or has been executed.

    Attributes:
        asked: awake time.
        is_over: it has been executed; `result` returns or raises its outcome.
    """

    def __init__(self, work: Callable[[], T]) -> None:
        self.asked = clocks.awake_time()
        self.is_over = False
        self._work = work
        self._outcome: Any = None
        self._fault: Exception | None = None
        self._over = _thread.allocate_lock()
        self._over.acquire()

    def execute(self) -> None:
        """Execute the call, in the thread."""
        try:
            self._outcome = self._work()
        except Exception as fault:  # noqa: BLE001 - the asker handles it, and the thread lives on
            self._fault = fault
        self.is_over = True
        self._over.release()

    def wait(self, seconds: float) -> bool:
        """Wait for the end of the call; return True if it is over."""
        return self.is_over or self._over.acquire(timeout=seconds)

    def result(self) -> T:
        """Return the result of a call that is over, or raise its exception."""
        if self._fault is not None:
            raise self._fault
        outcome: T = self._outcome
        return outcome


class FileThread:
    """Executes the calls on one directory, in order; its thread begins with the first call.

    Args:
        directory: named in the texts of exceptions.
        patience: most seconds that the loop waits for a call.
        report: takes the text of a failure of a call of `tell`, while the exception is handled.
    """

    def __init__(
        self, directory: str, patience: float = LATE, report: Callable[[str], object] = print
    ) -> None:
        self.directory = directory
        self._patience = patience
        self._report = report
        self._queue: SimpleQueue[Call[Any]] = SimpleQueue()
        self._unfinished: deque[Call[Any]] = deque()
        self._told: list[Call[None]] = []
        self._has_thread = False

    def begin(self, work: Callable[[], T]) -> Call[T]:
        """Queue a call, and return it. The caller bounds the number of its queued calls.

        Execute it at once where no thread can be started: there are too many, or a filter of system
        calls refuses them.
        """
        call = Call(work)
        self.pass_on()
        self._put(call)
        return call

    def _put(self, call: Call[Any]) -> None:
        if self._starts_thread():
            self._unfinished.append(call)
            self._queue.put(call)
        else:
            call.execute()

    def _starts_thread(self) -> bool:
        """Return True if there is a thread from now on."""
        if not self._has_thread:
            try:
                _thread.start_new_thread(self._work, ())
            except RuntimeError:
                return False
            self._has_thread = True
        return True

    def tell(self, work: Callable[[], object]) -> None:
        """Queue a call, which starts with the next `begin` or `pass_on`; `report` gets its failure.

        Until then the thread does not compete with the loop for the interpreter.
        """

        def guarded() -> None:
            try:
                work()
            except Exception as fault:  # noqa: BLE001 - as in `Call.execute`
                self._report(f"a call on {self.directory} failed: {fault}")

        self._told.append(Call(guarded))

    def pass_on(self) -> None:
        """Pass the calls of `tell` to the thread."""
        told, self._told = self._told, []
        for call in told:
            self._put(call)

    def ask(self, work: Callable[[], T]) -> T:
        """Return the result of a call.

        Raises:
            NoAnswer: the directory does not answer in time. The call may still be executed later.
                It is not queued where an earlier call is late.
        """
        if not self.is_late:
            call = self.begin(work)
            if self.ends(call):
                return call.result()
        raise NoAnswer(errno.ETIMEDOUT, "it does not answer")

    def ends(self, call: Call[Any]) -> bool:
        """Wait for the end of a call, unless the directory is late; return True if it is over."""
        return call.wait(0.0 if self.is_late else self._patience)

    def waits(self) -> float:
        """Return for how many seconds a call has had no answer; 0.0: no call waits."""
        with contextlib.suppress(IndexError):  # the thread ends the last call just now
            return clocks.awake_time() - self._unfinished[0].asked
        return 0.0

    @property
    def is_late(self) -> bool:
        """Return True if a call takes longer than the loop waits for one."""
        return self.waits() > self._patience

    def _work(self) -> None:
        while True:
            self._queue.get().execute()
            self._unfinished.popleft()
