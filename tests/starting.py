"""Starts of the supervisor without its loop: the caller waits for each exec."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

from rosrm.supervisor import spawn
from rosrm.supervisor.confinement import Steps, T


def finish(steps: Steps[T]) -> T:
    """Run a start to its end; return its result. In place of an attempt it may yield a pid."""
    step: Callable[[], spawn.Attempt] = partial(next, steps)
    while True:
        try:
            attempt = step()
        except StopIteration as done:
            return done.value
        try:
            pid = executed(attempt) if isinstance(attempt, spawn.Attempt) else attempt
        except (spawn.SpawnError, OSError) as fault:
            step = partial(steps.throw, fault)
        else:
            step = partial(steps.send, pid)


def executed(attempt: spawn.Attempt) -> int:
    """Wait until a process executes its program; return its pid. Raises what `check` raises."""
    while not attempt.read():
        pass
    attempt.close()
    try:
        attempt.check()
    except (spawn.SpawnError, OSError):
        os.waitpid(attempt.pid, 0)
        raise
    return attempt.pid
