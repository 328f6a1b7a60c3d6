"""JSON objects, one a line: how slave and supervisor speak, and how the record is written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

#: Longest line that is read.
LONGEST_LINE: Final = 8 << 20

_encoder: Final = json.JSONEncoder(separators=(",", ":"))


class ProtocolError(Exception):
    """The peer sent what cannot be understood; its text is meant for the peer."""


def line(fields: Mapping[str, Any]) -> bytes:
    """A JSON object in one line."""
    return _encoder.encode(fields).encode() + b"\n"


def parse(text: bytes) -> dict[str, Any]:
    """The JSON object in one line. Raises ProtocolError."""
    try:
        fields = json.loads(text)
    except ValueError as error:
        raise ProtocolError(f"not a line of JSON ({error}): {text[:80]!r}") from None
    if not isinstance(fields, dict):
        raise ProtocolError(f"not a JSON object: {text[:80]!r}")
    return fields


class Lines:
    """Cuts a stream into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes. Raises ProtocolError where one does not end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            raise ProtocolError(f"a line is longer than {LONGEST_LINE} bytes")
        return lines
