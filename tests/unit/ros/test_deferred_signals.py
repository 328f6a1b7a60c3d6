"""Ctrl-C in code of rclpy that replaces exceptions."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from rosrm.ros.deferred_signals import signals_deferred
from rosrm.ros.master_connection import wait_until


class Participant:
    """Fake participant: a signal arrives while C++ calls Python, and the exception is dropped."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def spin(self, timeout: float) -> None:
        try:
            os.kill(os.getpid(), self.number)
            time.sleep(0)
        except BaseException:  # noqa: BLE001 - as C++ does
            return


class Ended(BaseException):
    """Raised by a program's handler of SIGTERM."""


@pytest.fixture
def handler_of_sigterm() -> Iterator[None]:
    def end(number: int, frame: object) -> None:
        raise Ended

    before = signal.signal(signal.SIGTERM, end)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize(
    ("number", "expected"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Ended)]
)
def test_a_signal_during_a_wait_ends_the_wait(handler_of_sigterm, number, expected) -> None:
    """The exception of the program's handler is raised, whatever rclpy would have made of it."""
    before = signal.getsignal(number)
    with pytest.raises(expected):
        wait_until(Participant(number), lambda: False, time.monotonic() + 60.0)
    assert signal.getsignal(number) is before


def test_a_second_signal_is_handled_although_the_handler_of_the_first_raised() -> None:
    """Otherwise the second one would be lost."""
    handled: list[int] = []

    def handle(number: int, _frame: object) -> None:
        handled.append(number)
        raise Ended

    def raise_both() -> None:
        with signals_deferred():
            for number in numbers:
                signal.raise_signal(number)

    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, handle) for number in numbers]
    try:
        with pytest.raises(Ended):
            raise_both()
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    assert handled == list(numbers)


def test_other_threads_wait_as_before() -> None:
    """Python allows signal handlers in the main thread only."""
    ended = threading.Event()

    def wait() -> None:
        with signals_deferred():
            ended.set()

    thread = threading.Thread(target=wait)
    thread.start()
    thread.join(60.0)
    assert ended.is_set()
