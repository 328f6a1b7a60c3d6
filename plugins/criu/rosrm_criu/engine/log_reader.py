"""Why CRIU failed, as its log tells it."""

from __future__ import annotations

import re
from typing import Final

#: `(00.004711)    123: Error (criu/sk-inet.c:42): inet: Can't bind inet socket back: ...`
_ERROR: Final = re.compile(
    r"^(?:\(\s*\d+\.\d+\))?\s*(?:\d+:\s*)?Error\s*(?:\([^)]*\):?)?:?\s*(?P<said>.*\S)\s*$"
)
#: These stand beside every failure and say nothing of its cause.
_EMPTY: Final = re.compile(
    r"(?:Pre-)?(?:Dumping|Restoring) FAILED\.?|"
    r"(?:\d+ )?(?:exited, status=\d+|killed by signal \d+.*|stopped by signal \d+.*)|"
    r"Failed to restore .* task|Can't wait or bad status.*|"
    r"rlimit: Can't setup RLIMIT_NOFILE for self: .*"  # it goes on with fewer open files
)
#: Lines that a message has room for; CRIU says the cause first and what followed from it after.
_MOST: Final = 3


def causes(log: str) -> tuple[str, ...]:
    """The lines of a log that say why CRIU failed, the first cause first, each one once.

    Args:
        log: CRIU's log, or what it said on its standard error.
    """
    said = [match["said"] for line in log.splitlines() if (match := _ERROR.match(line))]
    telling = [line for line in said if not _EMPTY.fullmatch(line)] or said
    return tuple(dict.fromkeys(telling))[:_MOST]


def first_words(output: str) -> tuple[str, ...]:
    """What it said first where it has not called anything an error: how it may be used, mostly.

    Args:
        output: its standard output and error.
    """
    lines = (line.strip(" :") for line in output.splitlines())
    return tuple(line for line in lines if line and not line.startswith(("Warn", "(")))[:1]
