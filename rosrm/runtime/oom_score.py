"""Protection of an agent from the OOM killer, which ends the process with the highest score.

A process that leaks must be killed before the slave and the supervisor, which report and restart
it. A child inherits the score of its parent, so an agent takes back its former score while it
starts one. The supervisor imports this module: it stays small.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Final

from rosrm.wording import reason_of

#: Score of a protected agent. Not -1000, which exempts a process: a leak of the agent must end too.
PROTECTED: Final = -900
_FILE: Final = "/proc/self/oom_score_adj"
#: Score of this process and that of its children; equal: this process is not protected.
_scores = (0, 0)


def protect() -> str:
    """Lower the score of this process; return why that is impossible, "" if it is protected.

    The processes that it starts get the score that it had before; 0 if it was protected already,
    for example by systemd.
    """
    global _scores  # noqa: PLW0603 - an attribute of the process
    try:
        with open(_FILE, encoding="ascii") as file:
            present = int(file.read())
        if present > PROTECTED:
            with _writer() as write:
                write(PROTECTED)
    except OSError as error:
        return f"{_FILE} cannot be lowered: {reason_of(error)}"
    _scores = (PROTECTED, present) if present > PROTECTED else (present, 0)
    return ""


@contextlib.contextmanager
def score_of_children() -> Iterator[None]:
    """Take the score of the children for a while; a process that is started now keeps it."""
    own, children = _scores
    if own == children:
        yield
        return
    with _writer() as write:  # kept open, because a later open may fail
        write(children)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # the right to lower it was lost since
                write(own)


@contextlib.contextmanager
def _writer() -> Iterator[Callable[[int], object]]:
    descriptor = os.open(_FILE, os.O_WRONLY | os.O_CLOEXEC)
    try:
        yield lambda score: os.pwrite(descriptor, b"%d" % score, 0)
    finally:
        os.close(descriptor)
