"""Output of `rosrm logs`: the bytes of one process, optionally with times and its name.

rosrm adds lines that begin with `---`: one for each restart of the program, and one for dropped
output. With several processes the first start has such a line, too.
"""

from __future__ import annotations

import sys
import time
from codecs import IncrementalDecoder, getincrementaldecoder
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from rosrm.cli.output.legible import encoding, legible
from rosrm.cli.output.log_levels import Level
from rosrm.cli.output.log_search import LineContext, LineSearch, coloured, is_shown, json_line
from rosrm.client.logs import LogChunk
from rosrm.supervisor import log_index
from rosrm.wording import size

Marks = Sequence[tuple[float, int, int]]
#: Unix time by which the output was written, and the output; time 0.0: unknown.
Piece = tuple[float, bytes]
#: Bytes after which an endless line is divided.
_LONGEST_LINE: Final = 1 << 16


def show(pieces: Iterable[Piece]) -> None:
    """Write output to standard output."""
    for _, text in pieces:
        sys.stdout.buffer.write(text)
    sys.stdout.flush()


def is_terminal() -> bool:
    """Return True if standard output is a terminal, which executes control characters."""
    return sys.stdout.isatty()


@dataclass
class LogStream:
    """Output of one process in pieces.

    Attributes:
        name: name of the process.
        prefix: beginning of each line; b"": no prefix.
        timestamps: True: each line begins with the time by which it was written, by the clock of
            its host.
        raw: True: control characters, e.g. of colours, stay as the process wrote them.
        search: lines that are shown; None: all, and without a prefix bytes are copied unchanged.
        wrote: True after the first output.
    """

    name: str
    prefix: bytes = b""
    timestamps: bool = False
    raw: bool = True
    search: LineSearch | None = None
    wrote: bool = False
    _host: str = ""
    _number: int = 0
    _is_new: bool = False
    _unfinished: bytes = b""
    _shown: int = 0
    _when: float = 0.0
    _at_line_start: bool = True
    _context: LineContext = field(default_factory=LineContext)
    _pieces: list[Piece] = field(default_factory=list)
    _decoder: IncrementalDecoder = field(
        default_factory=lambda: getincrementaldecoder("utf-8")("backslashreplace")
    )

    def take(self) -> list[Piece]:
        """Return and clear the finished pieces."""
        pieces, self._pieces = self._pieces, []
        return pieces

    def write(self, chunk: LogChunk) -> None:
        """Add bytes of the process."""
        content, offset = chunk.content, chunk.offset
        marks = [mark for mark in chunk.marks if log_index.is_possible(mark[0])]
        if chunk.is_first:
            self.close()
            self._host, self._number, self._is_new = chunk.host, chunk.number, self.wrote
        begun = marks[0][0] if marks else 0.0
        starts = [(at, when) for when, at, pid in marks if pid and 0 <= at - offset < len(content)]
        if chunk.dropped:
            self._say(f"{size(chunk.dropped)} before this were dropped", begun)
        if self._is_new and content and (not starts or starts[0][0] > offset):
            self._say(f"on {self._host}", begun)
        done = offset
        for at, when in starts:
            self._text(content[done - offset : at - offset], done, marks)
            done = at
            if self.wrote or self.prefix:
                self._say(f"started on {self._host} at {_stamp(when)}", when)
            self.wrote = True
        self._text(content[done - offset :], done, marks)
        self._is_new = self._is_new and not content

    def close(self) -> None:
        """Complete an unfinished line."""
        if self._unfinished:
            self._complete(b"\n")

    def show_unfinished(self) -> None:
        """Show a line as far as it has come, such as a prompt, if it is shown in any case."""
        selects = self.search is not None and self.search.is_selective
        if self.prefix or selects or len(self._unfinished) == self._shown:
            return
        text, is_begun = self._unfinished[self._shown :], self._shown > 0
        stamp = b"" if is_begun or not self.timestamps else f"{_stamp(self._when)} ".encode()
        self._add(stamp + text, self._when)
        self._shown = len(self._unfinished)

    def _complete(self, end: bytes = b"") -> None:
        """Add the unfinished line, or the rest of it."""
        line, self._unfinished = self._unfinished + end, b""
        shown, self._shown = self._shown, 0
        if shown:
            self._context.add(line.decode(errors="replace"), self._when)
            self._add(line[shown:], self._when)
        else:
            self._line(line, self._when)

    def _say(self, text: str, when: float) -> None:
        """Add a line of rosrm; `when` orders it among the lines of other processes."""
        self.close()
        self._context.begin_program()
        search = self.search
        if search is not None and (search.is_selective or 0.0 < search.until < when):
            return
        if not self._at_line_start:
            self._add(b"\n")
        self._add(self.prefix + f"--- {text} ---\n".encode(), when)

    def _text(self, text: bytes, offset: int, marks: Marks) -> None:
        if not text:
            return
        self.wrote = True
        if not self.prefix and not self.timestamps and self.search is None:
            self._add(text)
            return
        at, late = offset, iter(marks)
        mark = next(late, None)
        for line in text.splitlines(keepends=True):
            at += len(line)
            while mark is not None and mark[1] < at:
                mark = next(late, None)
            self._when = mark[0] if mark else 0.0
            self._unfinished += line
            if line.endswith(b"\n"):
                self._complete()
            elif len(self._unfinished) > _LONGEST_LINE:
                self.close()

    def _line(self, line: bytes, when: float) -> None:
        text, context, search = line.decode(errors="replace"), self._context, self.search
        context.add(text, when)
        if search is not None and not is_shown(text, context, search):
            return
        if search is not None and search.as_json:
            form = json_line(text, context, self.name, self._host, self._number)
            self._pieces.append((context.time, form.encode()))
            return
        stamp = f"{_stamp(context.time)} ".encode() if self.timestamps else b""
        level = context.level if search is not None and search.coloured else None
        self._add(self.prefix + stamp + line, context.time, level)

    def _add(self, text: bytes, when: float = 0.0, level: Level | None = None) -> None:
        """Add a piece, in the colour of a level if one is given."""
        if not self.raw:  # a character may be divided between two pieces
            shown = legible(self._decoder.decode(text).replace("\r\n", "\n"))
            text = (shown if level is None else coloured(shown, level)).encode(encoding())
        self._pieces.append((when, text))
        self._at_line_start = text.endswith(b"\n")


def _stamp(when: float) -> str:
    """Return a time in the local time zone; "?" if the time is unknown."""
    if when <= 0.0:
        return "?"
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(when)) + f".{int(when * 10) % 10}"
