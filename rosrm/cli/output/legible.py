r"""Text of other hosts and users as a terminal can show it: other characters become numbers.

A character that the encoding of the terminal lacks becomes its number, as `\u2192`; a character
with which rosrm draws becomes one of ASCII with the same width, so that tables stay aligned.
"""

from __future__ import annotations

import codecs
import sys
from io import TextIOWrapper
from itertools import accumulate
from typing import IO, Final

from rosrm.wording import printable

#: Name of the error handler of the standard streams.
HANDLER: Final = "rosrm.legible"
_DRAWN: Final = {"█": "#", "▒": "+", "░": ".", "│": "|", "…": "~"}


def _number(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    part = error.object[error.start : error.end]
    numbered = (
        _DRAWN.get(letter) or letter.encode("ascii", "backslashreplace").decode() for letter in part
    )
    return "".join(numbered), error.end


codecs.register_error(HANDLER, _number)


def never_fail() -> None:
    """Let the standard streams accept every text that no other check has made legible."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors=HANDLER)


def legible(text: str, stream: IO[str] | None = None) -> str:
    """Return text as a stream, by default standard output, can show it."""
    code = encoding(stream)
    return printable(text).encode(code, HANDLER).decode(code)


def encoding(stream: IO[str] | None = None) -> str:
    """Return the encoding of a stream, by default of standard output."""
    return getattr(stream or sys.stdout, "encoding", None) or "utf-8"


def offsets(text: str) -> list[int]:
    """Return where each character of a text begins in the legible text, and its end."""
    return list(accumulate((len(legible(letter)) for letter in text), initial=0))
