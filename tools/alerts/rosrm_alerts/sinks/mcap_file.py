"""Event sink that writes notices to an MCAP file, for Foxglove, Lichtblick or PlotJuggler."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from rosrm import ConfigError, Notice, SkipPlugin
from rosrm.wording import reason_of

#: Topic of all notices.
TOPIC: Final = "/rosrm/events"
_LEVELS: Final = {"INFO": 2, "WARN": 3, "ERROR": 4}
#: Schema by which viewers recognise log messages, with the fields of a notice besides.
_SCHEMA: Final[dict[str, Any]] = {
    "type": "object",
    "title": "foxglove.Log",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
        **{name: {"type": "string"} for name in ("id", "kind", "process", "host", "alert")},
        "facts": {"type": "object"},
    },
}


@dataclass(frozen=True)
class McapOptions:
    """Options of the sink.

    Attributes:
        file: path of the new file; `{time}` is replaced by the time of the start, so that each run
            has a file.
    """

    file: str = ""

    def __post_init__(self) -> None:
        """Refuse an empty name; raises `ValueError`."""
        if not self.file:
            raise ValueError("file: a path is required, such as 'events-{time}.mcap'")


class McapFile:
    """Writes notices as JSON messages of the schema `foxglove.Log`."""

    def __init__(self, options: McapOptions) -> None:
        try:
            from mcap.writer import Writer  # noqa: PLC0415 - an optional dependency
        except ImportError:
            raise SkipPlugin("mcap is not installed: pip install 'rosrm-alerts[mcap]'") from None
        now = datetime.now(timezone.utc)  # noqa: TID251 - a plugin imports public names only
        start = now.strftime("%Y%m%dT%H%M%SZ")
        path = Path(options.file.replace("{time}", start)).expanduser()
        try:
            new = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._stream = os.fdopen(os.open(path, new, 0o600), "wb")  # events have no other reader
        except FileExistsError:
            raise ConfigError(
                f"{path} exists and is not overwritten; with `{{time}}` in the name each run has "
                f"its own file"
            ) from None
        except OSError as fault:
            raise ConfigError(f"{path} cannot be written: {reason_of(fault)}") from None
        # A chunk for each message: a file that is cut short has all others.
        self._writer = Writer(self._stream, chunk_size=1)
        self._writer.start(profile="", library="rosrm")
        schema = self._writer.register_schema(
            "foxglove.Log", "jsonschema", json.dumps(_SCHEMA).encode()
        )
        self._channel = self._writer.register_channel(TOPIC, "json", schema)

    def send(self, notices: Sequence[Notice]) -> None:
        """Append notices."""
        for notice in notices:
            stamp = round(notice.wall_time * 1e9)
            self._writer.add_message(self._channel, stamp, _message(notice, stamp), stamp)
        self._stream.flush()

    def close(self) -> None:
        """Complete the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


def _message(notice: Notice, stamp: int) -> bytes:
    seconds, nanoseconds = divmod(stamp, 10**9)
    form = {
        **notice.form(),
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "level": _LEVELS[notice.level],
        "name": notice.process or notice.host or "rosrm",
        "file": "",
        "line": 0,
    }
    return json.dumps(form).encode()
