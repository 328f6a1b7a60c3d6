"""Commands that wait or follow: they continue to ask a master that does not answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final, TypeVar

import typer

from rosrm.errors import NoMaster

T = TypeVar("T")

#: Seconds between two looks.
PERIOD: Final = 0.5


def ask_until_answered(look: Callable[[], T], deadline: float = math.inf) -> T:
    """Return the master's answer, however long it takes; the user reads of the silence once.

    Args:
        look: asks the master; raises `NoMaster` after some seconds without an answer.
        deadline: monotonic seconds after which the silence is an error.

    Raises:
        NoMaster: the master was silent at the deadline.
    """
    silent = False
    while True:
        try:
            answer = look()
        except NoMaster as error:
            if time.monotonic() >= deadline:
                raise NoMaster(f"--timeout has passed: {error}") from None
            if not silent:
                typer.echo(f"rosrm: {error} Asking again until the master answers", err=True)
            silent = True
            time.sleep(PERIOD)
        else:
            if silent:
                typer.echo("rosrm: the master answers again", err=True)
            return answer
