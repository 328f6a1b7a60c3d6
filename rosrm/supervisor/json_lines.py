"""JSON objects, one a line: encoding of the slave's and supervisor's messages and of the record."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

#: Longest accepted line, bytes.
LONGEST_LINE: Final = 8 << 20

_encoder: Final = json.JSONEncoder(separators=(",", ":"))


class ProtocolError(Exception):
    """The peer sent an unreadable message; the text is meant for the peer."""


def line(fields: Mapping[str, Any]) -> bytes:
    """Return a JSON object as one line."""
    return _encoder.encode(fields).encode() + b"\n"


def parse(text: bytes) -> dict[str, Any]:
    """Return the JSON object in one line. Raises ProtocolError."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not a line of JSON ({error}): {text[:80]!r}") from None
    if not isinstance(fields, dict):
        raise ProtocolError(f"not a JSON object: {text[:80]!r}")
    return fields


class LineSplitter:
    """Splits a stream into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes. Raises ProtocolError for one that is too long."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            raise ProtocolError(f"a line is longer than {LONGEST_LINE} bytes")
        return lines
