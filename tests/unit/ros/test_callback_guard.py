"""Guard of ROS callbacks: exceptions are logged with their place."""

from __future__ import annotations

import logging
import signal

import pytest

from benchmarks.stopping import Stopped
from rosrm.ros import convert
from rosrm.ros.callback_guard import CallbackGuard


def bad_message() -> None:
    convert.json_object("null", "a result")


@pytest.mark.parametrize("fault", [SystemExit(3), GeneratorExit(), ZeroDivisionError("oops")])
def test_nothing_that_a_callback_raises_gets_out(fault, caplog) -> None:
    """The guard catches exceptions that `except Exception` lets pass, too."""

    def callback() -> None:
        raise fault

    assert type(fault).__name__ in CallbackGuard().call(callback)
    assert len(caplog.messages) == 1


def test_the_log_names_the_callback_the_error_and_its_place(caplog) -> None:
    """The place is rosrm's own innermost frame, so that a bug can be reported."""
    CallbackGuard().call(bad_message)
    (line,) = caplog.messages
    assert line.startswith("callback bad_message failed, and its message was dropped: Refused: ")
    assert "rosrm/ros/convert.py:" in line


def test_a_callback_that_fails_often_is_logged_once_a_second_and_counted(caplog) -> None:
    """A thousand bad messages a second do not fill a disk."""
    now = [0.0]
    guard = CallbackGuard(clock=lambda: now[0])
    for _ in range(50):
        guard.call(bad_message)
    assert len(caplog.messages) == 1
    now[0] = 1.5
    guard.call(bad_message)
    assert caplog.messages[-1].endswith("; 49 more since the last line")


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt(), Stopped(signal.SIGTERM)])
def test_an_interrupt_is_kept_for_the_loop(caplog, interrupt) -> None:
    """Raise Ctrl-C and the exception of a signal handler once, in the loop, as no failure."""

    def callback() -> None:
        raise interrupt

    guard = CallbackGuard()
    with caplog.at_level(logging.DEBUG):
        assert guard.call(callback) == ""
    assert caplog.messages == []
    with pytest.raises(type(interrupt)):
        guard.raise_interrupt()
    guard.raise_interrupt()
