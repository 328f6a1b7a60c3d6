"""Dask: a task for each process, on three worker processes."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from benchmarks.peers import measuring

distributed: Any = importlib.import_module("distributed")


class Tasks:
    """Tasks whose results Dask does not reuse for another task."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Any:
        return self._client.map(function, items, pure=False)

    def results(self, handle: Any) -> list[Any]:
        return list(self._client.gather(handle))


@contextmanager
def opened(at_once: int) -> Iterator[Tasks]:
    threads = -(-at_once // measuring.SLOTS)
    with (
        distributed.LocalCluster(
            n_workers=measuring.SLOTS, threads_per_worker=threads, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield Tasks(client)


if __name__ == "__main__":
    measuring.main(measuring.of_executor(opened))
