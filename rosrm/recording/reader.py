"""Reader of recordings: the initial state of a master, and all events of its core."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from rosrm.errors import RecordError
from rosrm.model.codec import from_plain, to_plain
from rosrm.recording.encoding import Happened, decode, decode_decisions
from rosrm.recording.frames import CutShort, FrameKind, cut_short, frames
from rosrm.version import __version__

#: Tables of the journal from which a master's state is restored.
TABLES = ("host", "learned", "process", "migration", "cluster", "removed")

_Table = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Header:
    """Initial state of a recorded master.

    Attributes:
        software: version of rosrm.
        master: name of the cluster.
        config: the master's settings, as `ClusterConfig.to_json` has them.
        epoch: epoch of the master.
        started: time, in seconds by its monotonic clock, at which its state was restored.
        intents: intents in its journal at the start, by table.
    """

    software: str
    master: str
    config: Mapping[str, Any]
    epoch: int
    started: float
    intents: Mapping[str, _Table]

    def encoded(self) -> bytes:
        """Return the content of the header's frame."""
        return json.dumps(to_plain(self), separators=(",", ":")).encode()


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole recording.

    Attributes:
        name: name of the file.
        events: events in the order in which the core handled them.
        end: why the recording ends: "stopped: SIGINT", "full: …" or "cut short".
    """

    name: str
    header: Header
    events: tuple[Happened, ...]
    end: str

    @property
    def length(self) -> float:
        """Return the seconds from the master's start to the last event."""
        return self.events[-1].now - self.header.started if self.events else 0.0


def read_record(file: BinaryIO, name: str, *, cut: bool = False) -> Recording:
    """Read a recording.

    Args:
        file: opened at its beginning.
        name: name of the file, for messages.
        cut: True: accept the complete frames of a file that is cut short.

    Raises:
        RecordError: no recording, damaged, cut short, or of another version.
    """
    reader = _Reader(name)
    try:
        for kind, content, at in frames(file, name):
            reader.take(kind, content, at)
        if not reader.end:
            raise cut_short(name, reader.at)
    except CutShort:
        if not cut or reader.header is None:
            raise
        reader.end = "cut short"
    return reader.recording()


class _Reader:
    """Builder of a recording from its frames."""

    def __init__(self, name: str) -> None:
        self.header: Header | None = None
        self.end = ""
        self.at = 0
        self._name = name
        self._events: list[Happened] = []

    def take(self, kind: FrameKind, content: bytes, at: int) -> None:
        """Add the next frame."""
        self.at = at
        if (kind is FrameKind.HEADER) is not (self.header is None) or self.end:
            raise self._nonsense("a frame of this kind is not allowed there")
        try:
            self._take(kind, content)
        except (ValueError, TypeError, KeyError) as fault:
            raise self._nonsense(str(fault)) from None

    def _take(self, kind: FrameKind, content: bytes) -> None:
        if kind is FrameKind.HEADER:
            self.header = from_plain(Header, json.loads(content))
        elif kind is FrameKind.END:
            self.end = content.decode() or "ended"
        elif kind is FrameKind.DECISIONS:
            last = self._events[-1] if self._events else None
            if last is None:
                raise ValueError("decisions before any event")
            lines = decode_decisions(content)
            self._events[-1] = Happened(last.now, last.wall, last.event, lines)
        else:
            event = decode(kind, content)
            if self._events and event.now < self._events[-1].now:
                raise ValueError("its time is before that of the previous event")
            self._events.append(event)

    def _nonsense(self, what: str) -> RecordError:
        wrote = f" (written by rosrm {self.header.software})" if self.header else ""
        return RecordError(
            f"{self._name}: the frame at byte {self.at} is invalid for rosrm {__version__}"
            f"{wrote}: {what}"
        )

    def recording(self) -> Recording:
        """Return the recording of all frames."""
        if self.header is None:
            raise cut_short(self._name, self.at)
        return Recording(self._name, self.header, tuple(self._events), self.end)
