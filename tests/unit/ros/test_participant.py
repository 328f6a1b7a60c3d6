"""Loop of a rosrm participant: ready callbacks run as one bounded group."""

from __future__ import annotations

import time

import pytest

from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.participant import Participant
from rosrm_msgs import msg


class Executor:
    """Fake rclpy executor; each turn calls one ready callback.

    Args:
        ready: number of ready callbacks; None: unlimited.
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
    made.guard = CallbackGuard()
    made.executor = executor = Executor(ready)
    executor.callback = made.counted(lambda: None)
    return made, executor


def test_all_that_is_ready_is_one_group() -> None:
    """The loop waits for the first callback only, and stops when none is ready."""
    made, executor = participant(ready=3)
    made.spin(7.0)
    assert executor.turns == [7.0, 0.0, 0.0, 0.0]


def test_the_loop_reports_if_it_called_a_callback() -> None:
    """A caller that empties its queues detects their end without measuring times."""
    assert participant(ready=3)[0].spin(0.0)
    assert not participant(ready=0)[0].spin(0.0)


def test_a_flood_does_not_keep_a_part_from_its_other_work() -> None:
    """A master under continuous requests still sends its beats."""
    made, executor = participant(ready=None)
    began = time.monotonic()
    made.spin(7.0)
    assert time.monotonic() - began < 5.0
    assert len(executor.turns) > 2


def test_ctrl_c_in_a_callback_ends_the_loop() -> None:
    """The interrupt is raised in Python code, not through the executor."""
    made, executor = participant(ready=1)

    def interrupted() -> None:
        raise KeyboardInterrupt

    executor.callback = made.counted(interrupted)
    with pytest.raises(KeyboardInterrupt):
        made.spin(1.0)


def test_a_message_beyond_its_bounds_costs_only_itself(caplog) -> None:
    """The callback of a topic is not called with it."""
    taken: list[object] = []
    made, _ = participant(ready=0)
    callback = made.counted(taken.append)
    for name in ("fine", 65_537 * "n"):
        callback(msg.MasterBeat(name=name))
    assert [one.name for one in taken] == ["fine"]
    assert "MasterBeat.name has 65537 characters; at most 65536" in caplog.text
