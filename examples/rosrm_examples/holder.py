"""A process that holds memory, and does nothing else.

    python -m rosrm_examples.holder --mb 40 --seconds 30

It holds N MB (1 MB = 10^6 bytes) in addition to its own footprint, every page touched, until SIGINT
or SIGTERM comes or its time is over, and exits with status 0. With --ros it is a ROS 2 node;
without, it imports very little.
"""

from __future__ import annotations

import argparse
import math
import mmap
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

STOP_SIGNALS = {signal.SIGINT, signal.SIGTERM}
GROWTH_PERIOD_S = 0.1


def main(arguments: Sequence[str] | None = None) -> int:
    """Hold memory until a stop signal; return the exit status."""
    # A blocked signal stays pending until the program waits for it: no handler, none is lost.
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    raw = list(sys.argv if arguments is None else ["holder", *arguments])
    options, ros_arguments = _parse(raw[1:])
    try:
        with _ros_node(ros_arguments) if options.ros else nullcontext():
            _hold(options.mb, options.grow, options.most, options.seconds)
    except (OSError, OverflowError) as error:
        print(f"holder: no more memory to be had: {error}", file=sys.stderr)
        return 1
    return 0


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Split the own options from those that `--ros-args` begins."""
    at = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    parser = argparse.ArgumentParser(prog="python -m rosrm_examples.holder")
    parser.add_argument("--mb", required=True, type=_amount, help="MB to hold")
    parser.add_argument("--seconds", type=_amount, help="for how long; without: until a signal")
    parser.add_argument("--grow", type=_amount, default=0.0, help="MB more in every second")
    parser.add_argument("--most", type=_amount, default=math.inf, help="MB up to which it grows")
    parser.add_argument("--ros", action="store_true", help="be a ROS 2 node")
    return parser.parse_args(arguments[:at]), arguments[at:]


def _amount(text: str) -> float:
    try:
        amount = float(text)
    except ValueError:
        amount = math.nan
    if not 0 <= amount < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number from 0")
    return amount


def _hold(mb: float, grow: float, most: float, seconds: float | None) -> None:
    """Hold `mb` MB, and `grow` MB more a second, until a stop signal or the time is over."""
    blocks = [_touched(int(mb * 1e6))]
    held = mb
    started = time.monotonic()
    while True:
        spent = time.monotonic() - started
        if seconds is not None and spent >= seconds:
            return
        wanted = max(mb, min(mb + grow * spent, most))
        blocks.append(_touched(int((wanted - held) * 1e6)))
        held = wanted
        left = math.inf if seconds is None else seconds - spent
        if _stopped_within(min(left, GROWTH_PERIOD_S if grow else 3600.0)):
            return


def _touched(size: int) -> mmap.mmap | None:
    """Map `size` bytes and write to each page, so that all of it is resident."""
    if size <= 0:
        return None
    block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    pages = len(range(0, size, mmap.PAGESIZE))
    block[:: mmap.PAGESIZE] = b"\x01" * pages
    return block


def _stopped_within(seconds: float) -> bool:
    return signal.sigtimedwait(STOP_SIGNALS, seconds) is not None


def _ros_node(arguments: list[str]) -> AbstractContextManager[object]:
    """Run a ROS 2 node for the lifetime of the context."""
    from rosrm_examples.lean_node import lean_node  # noqa: PLC0415 (rclpy with --ros alone)

    return lean_node("holder", arguments)


if __name__ == "__main__":
    sys.exit(main())
