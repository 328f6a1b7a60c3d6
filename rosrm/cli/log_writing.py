"""The output of `rosrm logs`: the bytes of one process, with times and its name on demand.

Lines of rosrm's own begin with `---`: where a program starts another time, and what is missing.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

Marks = Sequence[tuple[float, int, int]]


@dataclass
class Stream:
    """One process on standard output.

    Attributes:
        name: of the process.
        prefix: begins each line; b"": no prefix, and bytes are copied as they are.
        timestamps: each line begins with the time by which it was written, by its host's clock.
        wrote: there was something to print.
    """

    name: str
    prefix: bytes = b""
    timestamps: bool = False
    wrote: bool = False
    _host: str = ""
    _is_new: bool = False
    _unfinished: bytes = b""
    _when: float = 0.0
    _at_line_start: bool = True

    def enter(self, host: str) -> None:
        """Begin with another instance, on a host."""
        self._host, self._is_new = host, self.wrote

    def write(self, content: bytes, offset: int, marks: Marks) -> None:
        """Print a part; `offset` is that of its first byte, like the offsets of the marks."""
        starts = [(at, when) for when, at, pid in marks if pid and 0 <= at - offset < len(content)]
        if self._is_new and content and (not starts or starts[0][0] > offset):
            self.say(f"on {self._host}")
        done = offset
        for at, when in starts:
            self._text(content[done - offset : at - offset], done, marks)
            done = at
            if self.wrote:
                self.say(f"started on {self._host} at {_stamp(when)}")
            self.wrote = True
        self._text(content[done - offset :], done, marks)
        self._is_new = self._is_new and not content
        sys.stdout.flush()

    def say(self, text: str) -> None:
        """Print a line of rosrm's own."""
        self.close()
        if not self._at_line_start:
            sys.stdout.buffer.write(b"\n")
            self._at_line_start = True
        sys.stdout.buffer.write(f"--- {self.name}: {text} ---\n".encode())

    def close(self) -> None:
        """Print an unfinished line that waits for its end."""
        if self._unfinished:
            self._line(self._unfinished + b"\n", self._when)
            self._unfinished = b""
        sys.stdout.flush()

    def _text(self, text: bytes, offset: int, marks: Marks) -> None:
        if not text:
            return
        self.wrote = True
        if not self.prefix and not self.timestamps:
            sys.stdout.buffer.write(text)
            self._at_line_start = text.endswith(b"\n")
            return
        at, late = offset, iter(marks)
        mark = next(late, None)
        for line in text.splitlines(keepends=True):
            at += len(line)
            while mark is not None and mark[1] < at:
                mark = next(late, None)
            self._when = mark[0] if mark else 0.0
            if line.endswith(b"\n"):
                self._line(self._unfinished + line, self._when)
                self._unfinished = b""
            else:
                self._unfinished += line

    def _line(self, line: bytes, when: float) -> None:
        stamp = f"{_stamp(when)} ".encode() if self.timestamps else b""
        sys.stdout.buffer.write(self.prefix + stamp + line)


def _stamp(when: float) -> str:
    """Return a time of this host's zone: a log from before there were times has "?"."""
    if when <= 0.0:
        return "?"
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(when)) + f".{int(when * 10) % 10}"
