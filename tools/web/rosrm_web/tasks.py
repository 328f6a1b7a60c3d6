"""Tasks of the gateway that serve until its end; a fault repeats them and is logged."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from rosrm.threads import Pauses, log_fault


def serve_always(work: Callable[[], Awaitable[object]], name: str) -> asyncio.Task[None]:
    """Return a task that calls `work`, and calls it again after a fault and a pause.

    Args:
        work: serves until the task is cancelled.
        name: of the task, for the log.
    """

    async def run() -> None:
        pauses = Pauses()
        while True:
            try:
                await work()
            except Exception as fault:  # noqa: BLE001 - the task serves others, too
                pause = pauses.after_fault()
                log_fault(f"task {name}", fault, pause)
                await asyncio.sleep(pause)
            else:
                return

    return asyncio.get_running_loop().create_task(run(), name=name)
