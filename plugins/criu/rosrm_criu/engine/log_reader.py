"""Error messages in CRIU's logs."""

from __future__ import annotations

import re
from typing import Final

#: `(00.004711)    123: Error (criu/sk-inet.c:42): inet: Can't bind inet socket back: ...`
_ERROR: Final = re.compile(
    r"^(?:\(\s*\d+\.\d+\))?\s*(?:\d+:\s*)?Error\s*(?:\([^)]*\):?)?:?\s*(?P<said>.*\S)\s*$"
)
#: These messages accompany every failure and do not name its cause.
_EMPTY: Final = re.compile(
    r"(?:Pre-)?(?:Dumping|Restoring) FAILED\.?|"
    r"(?:\d+ )?(?:exited, status=\d+|killed by signal \d+.*|stopped by signal \d+.*)|"
    r"Failed to restore .* task|Can't wait or bad status.*|"
    r"rlimit: Can't setup RLIMIT_NOFILE for self: .*"  # CRIU continues with fewer open files
)
#: Most lines in an error message; CRIU logs the cause first, then its consequences.
_MOST: Final = 3


def causes(log: str) -> tuple[str, ...]:
    """Return the lines of a log that explain CRIU's failure, first cause first, without repeats.

    Args:
        log: CRIU's log, or its output on standard error.
    """
    said = [match["said"] for line in log.splitlines() if (match := _ERROR.match(line))]
    telling = [line for line in said if not _EMPTY.fullmatch(line)] or said
    return tuple(dict.fromkeys(telling))[:_MOST]


def first_words(output: str) -> tuple[str, ...]:
    """Return the first line of output that names no error: mostly a note on usage.

    Args:
        output: CRIU's standard output and error.
    """
    lines = (line.strip(" :") for line in output.splitlines())
    return tuple(line for line in lines if line and not line.startswith(("Warn", "(")))[:1]
