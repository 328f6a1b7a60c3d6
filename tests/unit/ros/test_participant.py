"""The loop of a part of rosrm: what is ready is done as one group, but not without an end."""

from __future__ import annotations

import time

from rosrm.ros.participant import Participant


class Executor:
    """Stands for rclpy's: each turn calls one callback, as long as there are any.

    Args:
        ready: callbacks that are ready; None: there is no end of them.
    """

    def __init__(self, ready: int | None) -> None:
        self.ready = ready
        self.turns: list[float] = []

    def spin_once(self, timeout_sec: float) -> None:
        self.turns.append(timeout_sec)
        if self.ready is None or self.ready >= len(self.turns):
            self.callback()


def participant(ready: int | None) -> tuple[Participant, Executor]:
    made = Participant.__new__(Participant)
    made._executed = 0
    made.executor = executor = Executor(ready)
    executor.callback = made.counted(lambda: None)
    return made, executor


def test_all_that_is_ready_is_one_group() -> None:
    """It waits for the first only, and stops when nothing is left."""
    made, executor = participant(ready=3)
    made.spin(7.0)
    assert executor.turns == [7.0, 0.0, 0.0, 0.0]


def test_a_flood_does_not_keep_a_part_from_its_other_work() -> None:
    """A master that is asked without an end still says its beats."""
    made, executor = participant(ready=None)
    began = time.monotonic()
    made.spin(7.0)
    assert time.monotonic() - began < 5.0
    assert len(executor.turns) > 2
