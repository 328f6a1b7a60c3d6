"""The bare loop: threads that start processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from benchmarks.peers import measuring


class Loop:
    """A pool of threads."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future[Any]]:
        return [self._pool.submit(function, one) for one in items]

    def results(self, handle: list[Future[Any]]) -> list[Any]:
        return [one.result() for one in handle]


@contextmanager
def opened(at_once: int) -> Iterator[Loop]:
    with ThreadPoolExecutor(at_once) as pool:
        yield Loop(pool)


if __name__ == "__main__":
    measuring.main(measuring.of_executor(opened))
