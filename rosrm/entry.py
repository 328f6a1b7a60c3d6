"""What the entry modules of both runtimes share: logging, the handover, how errors are told."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Callable
from types import FrameType

from rosrm.errors import RosrmError
from rosrm.handover import Handover, take_over


def handle_stop_signals(handler: Callable[[int, FrameType | None], None]) -> None:
    """Have SIGINT, SIGTERM and SIGHUP (the terminal was closed) handled alike.

    A SIGHUP that is ignored, as by `nohup`, stays ignored.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def run(role: str, serve: Callable[[Handover], int]) -> int:
    """Take over what the command handed over, and serve; returns the exit code.

    Args:
        role: "master" or "slave".
        serve: runs until it is told to stop; what it raises for the user is printed.
    """
    # Who started us held them back (see `interrupts_held`); by now they end us without a word.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s",
        datefmt="%H:%M:%S",
    )  # fmt: skip
    try:
        return serve(take_over(sys.argv[1:]))
    except RosrmError as error:
        sys.stderr.write(f"rosrm {role}: {error}\n")
        return error.exit_code
