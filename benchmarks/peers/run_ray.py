"""Ray: a task for each process, on one node with a CPU for each slot."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from benchmarks.peers import measuring

ray: Any = importlib.import_module("ray")


class Tasks:
    """Tasks of one CPU each."""

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Any:
        remote = ray.remote(function)
        return [remote.remote(one) for one in items]

    def results(self, handle: Any) -> list[Any]:
        return list(ray.get(handle))


@contextmanager
def opened(at_once: int) -> Iterator[Tasks]:
    ray.init(num_cpus=at_once, include_dashboard=False, logging_level=logging.ERROR)
    try:
        yield Tasks()
    finally:
        ray.shutdown()


if __name__ == "__main__":
    measuring.main(measuring.of_executor(opened))
