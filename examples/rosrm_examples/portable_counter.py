"""A counter that migrates with its whole memory, by CRIU: it publishes no state.

    python -m rosrm_examples.portable_counter --mb 100 --period 0.02 --write 0.01

It holds MB of memory and publishes on `count` (std_msgs/Int64MultiArray) the count, 1, 2, 3, ...;
the number of complete reads of its memory; and the CRC-32 of its content at the last one.
With `--write` the node also inverts a part of its memory at each count. The checksum remains that
of the original content, so it must not change.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import zlib
from collections.abc import Iterator, Sequence

from std_msgs.msg import Int64MultiArray

from rosrm_criu.node import PortableNode, run_portable

#: Bytes that are read at each count, so that no count takes long.
SLICE = 4_000_000
#: Each byte with all bits inverted, for `bytes.translate`.
INVERTED = bytes(reversed(range(256)))


class PortableCounter(PortableNode):
    """A counter that reads its memory over and over.

    Args:
        mb: of memory, 1 MB = 10^6 bytes; the content is the same in each run.
        period: seconds between two counts.
        write: share of the memory that is inverted each second.
    """

    def __init__(self, mb: float = 1.0, period: float = 0.1, write: float = 0.0) -> None:
        super().__init__("portable_counter")
        self.memory = filled(int(mb * 1e6))
        self.period = period
        self.count = self.passes = self.checksum = 0
        self.at = self.checksum_so_far = 0
        self.write = write
        self.written, self.inverts = 0, True

    def join(self) -> None:
        """Create the publisher and the timer, also after each migration."""
        self.output = self.create_publisher(Int64MultiArray, "count", 100)
        self.create_timer(self.period, self.tick)

    def tick(self) -> None:
        """Count, and publish."""
        self.read_on()
        self.write_on(int(self.write * self.period * len(self.memory)))
        self.count += 1
        self.output.publish(Int64MultiArray(data=[self.count, self.passes, self.checksum]))

    def read_on(self) -> None:
        """Read the next slice of the memory."""
        for part in self.original(self.at, self.at + SLICE):
            self.checksum_so_far = zlib.crc32(part, self.checksum_so_far)
        self.at += SLICE
        if self.at >= len(self.memory):
            self.passes, self.checksum = self.passes + 1, self.checksum_so_far
            self.at = self.checksum_so_far = 0

    def original(self, begin: int, end: int) -> Iterator[bytearray]:
        """Yield a part of the memory with its original content.

        The bytes before the index `written` have been inverted once more than those after it.
        """
        for first, after, inverted in (
            (begin, min(end, self.written), self.inverts),
            (max(begin, self.written), end, not self.inverts),
        ):
            part = self.memory[first:after]
            yield part.translate(INVERTED) if inverted else part

    def write_on(self, size: int) -> None:
        """Invert the next bytes of the memory."""
        part = slice(self.written, self.written + size)
        self.memory[part] = self.memory[part].translate(INVERTED)
        self.written += size
        if self.written >= len(self.memory):
            self.written, self.inverts = 0, not self.inverts


def filled(size: int) -> bytearray:
    """Return so many random bytes, the same in each call."""
    memory = bytearray(size)
    chance = random.Random(0)  # noqa: S311 - no secret
    for at in range(0, size, SLICE):
        memory[at : at + SLICE] = chance.randbytes(min(SLICE, size - at))
    return memory


def main(arguments: Sequence[str] | None = None) -> None:
    """Count until a stop signal."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    at = given.index("--ros-args") if "--ros-args" in given else len(given)
    parser = argparse.ArgumentParser(prog="python -m rosrm_examples.portable_counter")
    parser.add_argument("--mb", type=_positive, default=1.0, help="MB of memory")
    parser.add_argument("--period", type=_positive, default=0.1, help="seconds between two counts")
    parser.add_argument(
        "--write", type=_positive, default=0.0,
        help="share of the memory that is inverted each second, e.g. 0.01 (default: 0)",
    )  # fmt: skip
    options = parser.parse_args(given[:at])
    run_portable(
        lambda: PortableCounter(options.mb, options.period, options.write), args=given[at:]
    )


def _positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return number


if __name__ == "__main__":
    main()
