"""Attempts of migrations by `criu`: a step runs once, and stops if the master gives its attempt up.

A master may request a step twice, or undo a migration while a step is under way. So steps are
identified by the attempt.
"""

from __future__ import annotations

import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any, Final

from rosrm.errors import CriuError

Answer = Mapping[str, Any]

#: Steps whose answers are kept; far more than there are migrations at a time.
_REMEMBERED: Final = 100

_changing: Final = threading.Lock()
_flights: Final[dict[tuple[str, str], Future[Answer]]] = {}
_dumping: Final[defaultdict[int, threading.Lock]] = defaultdict(threading.Lock)
_turned_back: Final[set[str]] = set()


def once(step: str, attempt: str, work: Callable[[], Answer]) -> Answer:
    """Run a step once per attempt; repeated calls, also concurrent ones, get the same answer.

    Args:
        step: its name.
        attempt: id of the migration attempt.
        work: the step. If it raises, its result is dropped, and the next call runs it again.
    """
    with _changing:
        flight = _flights.get((step, attempt))
        is_ours = flight is None
        if flight is None:
            flight = _flights[step, attempt] = Future()
            while len(_flights) > _REMEMBERED:
                del _flights[next(iter(_flights))]
    if not is_ours:
        return flight.result()
    try:
        answer = work()
    except BaseException as error:
        with _changing:
            _flights.pop((step, attempt), None)
        flight.set_exception(error)
        raise
    flight.set_result(answer)
    return answer


def after(step: str, attempt: str, timeout: float) -> None:
    """Wait for the end of a step under way.

    Args:
        step: its name.
        attempt: id of the migration attempt.
        timeout: seconds.

    Raises:
        CriuError: the step is still under way.
    """
    with _changing:
        flight = _flights.get((step, attempt))
    if flight is None:
        return
    try:
        flight.exception(timeout)
    except TimeoutError:
        raise CriuError(f"{step} is still under way after {timeout:g} s") from None


@contextlib.contextmanager
def alone(number: int, timeout: float) -> Iterator[None]:
    """Exclude other dumps of an instance.

    Args:
        number: of the instance.
        timeout: seconds to wait for another dump.

    Raises:
        CriuError: another dump is still under way after `timeout` seconds.
    """
    with _changing:
        lock = _dumping[number]
    if not lock.acquire(timeout=timeout):
        raise CriuError(f"another dump of it is still under way after {timeout:g} s")
    try:
        yield
    finally:
        lock.release()


def is_busy(number: int) -> bool:
    """Return True if this slave is dumping an instance."""
    with _changing:
        return _dumping[number].locked()


def turn_back(attempt: str) -> None:
    """Mark an attempt as given up by the master, so that its steps under way stop."""
    with _changing:
        _turned_back.add(attempt)


def check_wanted(attempt: str) -> None:
    """Raise `CriuError` if the attempt was given up."""
    with _changing:
        if attempt in _turned_back:
            raise CriuError("the move was undone")
