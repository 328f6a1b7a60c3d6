"""Calls on a directory in a thread: order, late answers, and no thread."""

from __future__ import annotations

import threading
import time

import pytest

from rosrm.runtime import file_thread
from rosrm.runtime.file_thread import FileThread, NoAnswer
from tests.waiting import wait_until


@pytest.fixture
def disk():
    return FileThread("/state", patience=0.5)


@pytest.fixture
def gate():
    """Return an event that holds up a call until the end of the test."""
    gate = threading.Event()
    yield gate
    gate.set()


def test_calls_are_executed_in_order_in_one_thread(disk):
    done = []
    for number in range(100):
        disk.tell(lambda number=number: done.append((number, threading.get_ident())))
    there = disk.ask(threading.get_ident)
    assert done == [(number, there) for number in range(100)]
    assert there != threading.get_ident()


def test_an_exception_is_that_of_the_one_who_asks(disk):
    with pytest.raises(ZeroDivisionError):
        disk.ask(lambda: 1 // 0)
    assert disk.ask(lambda: 1) == 1


def test_a_late_directory_is_waited_for_once(disk, gate):
    """Calls that were not queued then are not executed later."""
    done = []
    disk.begin(gate.wait)
    began = time.monotonic()
    for number in range(50):
        with pytest.raises(NoAnswer, match="does not answer"):
            disk.ask(lambda number=number: done.append(number))
    assert time.monotonic() - began < 5.0
    assert disk.is_late
    gate.set()
    wait_until(lambda: disk.waits() == 0.0, "the late call ends")
    assert done == [0]
    assert disk.ask(lambda: 1) == 1


def test_calls_are_executed_at_once_where_there_is_no_thread(disk, monkeypatch):
    """A supervisor whose number of threads is limited serves as before."""

    def refuse(*_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(file_thread._thread, "start_new_thread", refuse)
    assert disk.ask(threading.get_ident) == threading.get_ident()
    assert not disk.is_late
