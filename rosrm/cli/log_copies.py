"""Copy of process logs to standard output, merged by time, for `rosrm logs`."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from heapq import merge
from operator import itemgetter
from typing import TYPE_CHECKING

import typer

from rosrm import clocks
from rosrm.cli.options import seconds_of
from rosrm.cli.output import reader
from rosrm.cli.output.log_lines import LogStream, Piece, show
from rosrm.cli.output.plain import echo
from rosrm.client.logs import PERIOD, LogReader, LogSelection
from rosrm.errors import RosrmError

if TYPE_CHECKING:
    from rosrm.archive.reader import LogArchive
    from rosrm.client.client import Client


def time_of(option: str, text: str) -> float:
    """Return the time in an option as unix time (s), 0.0 if it is not given.

    Args:
        option: name of the option, for messages.
        text: a time span before now, or a date with or without a time, local unless it says so.

    Raises:
        ConfigError: the text is neither.
    """
    if not text:
        return 0.0
    try:
        return datetime.fromisoformat(re.sub(r"[zZ]$", "+00:00", text)).timestamp()
    except (ValueError, OverflowError):
        hint = ". Give a time span up to now, e.g. 10min, or a time, e.g. 2026-11-27T09:30"
        return clocks.wall_time() - seconds_of(option, text, hint=hint)


def copy_logs(
    client: Client, streams: Sequence[LogStream], selection: LogSelection,
    archive: LogArchive | None = None,
) -> None:  # fmt: skip
    """Copy the logs of processes to standard output by the times of their lines; follow all.

    An unreachable log is reported at once, and the others are copied.

    Raises:
        typer.Exit: a log could not be copied.
    """
    readers = client.log_readers([stream.name for stream in streams], selection, archive)
    copies = [_Copy(reader, stream) for reader, stream in zip(readers, streams, strict=True)]
    # `merge` takes the earliest of the next pieces. A piece without a time follows its predecessor.
    show(merge(*(copy.begin() for copy in copies), key=itemgetter(0)))
    if selection.follow:
        with reader.needed():
            _follow([copy for copy in copies if not copy.reader.at_end])
    if exit_code := max(copy.exit_code for copy in copies):
        raise typer.Exit(exit_code)


def _follow(copies: Sequence[_Copy]) -> None:
    """Copy new output until all processes have ended."""
    while copies:
        news = False
        for copy in copies:
            news = copy.poll() or news
            if copy.reader.at_end:
                copy.stream.close()
            show(copy.stream.take())
        copies = [copy for copy in copies if not copy.reader.at_end]
        if copies and not news:
            for copy in copies:
                copy.stream.show_unfinished()
                show(copy.stream.take())
            time.sleep(PERIOD)


@dataclass
class _Copy:
    """Copy of the log of one process.

    Attributes:
        reader: reader of the log.
        stream: converts the bytes to output.
        exit_code: exit code of the error that ended the copy; 0: none.
    """

    reader: LogReader
    stream: LogStream
    exit_code: int = 0

    def begin(self) -> Iterator[Piece]:
        """Copy the existing log; return it in pieces."""
        try:
            for chunk in self.reader.read():
                self.stream.write(chunk)
                yield from self.stream.take()
        except RosrmError as error:
            self._fail(error)
        if self.reader.at_end or not self.reader.selection.follow:
            self.stream.close()
        yield from self.stream.take()

    def poll(self) -> bool:
        """Copy new output; return False if there was none."""
        try:
            chunk = self.reader.poll()
        except RosrmError as error:
            self._fail(error)
            return False
        if chunk is not None:
            self.stream.write(chunk)
        return chunk is not None

    def _fail(self, error: RosrmError) -> None:
        """Report that the log cannot be read any more."""
        self.reader.at_end, self.exit_code = True, error.exit_code
        echo(f"rosrm: {error}", err=True)
