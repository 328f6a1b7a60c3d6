"""A thread that does blocking work for a loop, in order, and returns the outcomes to the loop."""

from __future__ import annotations

import queue
from collections.abc import Callable
from functools import partial
from typing import Any

from rosrm import threads


class Worker:
    """A thread for file operations, which must not block a loop; it begins with the first one.

    Args:
        name: of the thread.
        post: schedules a call in the loop; may be called from any thread.
    """

    def __init__(self, name: str, post: Callable[[Callable[[], None]], None]) -> None:
        self._name = name
        self._post = post
        self._jobs: queue.SimpleQueue[Callable[[], None]] | None = None

    def run(
        self, work: Callable[[], Any], then: Callable[[Any], None],
        failed: Callable[[Exception], None],
    ) -> None:  # fmt: skip
        """Call `work` in the thread, then in the loop `then` with its result.

        If `work` raises, `failed` is called in the loop with the exception.
        """

        def job() -> None:
            try:
                outcome = partial(then, work())
            except Exception as error:  # noqa: BLE001 - the loop handles it, and the thread lives on
                outcome = partial(failed, error)
            self._post(outcome)

        try:
            self._started().put(job)
        except RuntimeError as error:  # no thread can be started
            self._post(partial(failed, error))

    def _started(self) -> queue.SimpleQueue[Callable[[], None]]:
        if self._jobs is None:
            jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
            threads.start(partial(_work, jobs), self._name, again=True)
            self._jobs = jobs
        return self._jobs


def _work(jobs: queue.SimpleQueue[Callable[[], None]]) -> None:
    while True:
        jobs.get()()
