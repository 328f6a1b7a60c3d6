"""CRIU's logs: the cause of a failure, and its explanation in one plain sentence.

The explanations were collected from dumps and restores of such processes with CRIU 4.2.1. A message
that is not in the tables is passed on unchanged.
"""

from __future__ import annotations

import re
from typing import Final

#: `(00.004711)    123: Error (criu/sk-inet.c:42): inet: Can't bind inet socket back: ...`
_ERROR: Final = re.compile(
    r"^(?:\(\s*\d+\.\d+\))?\s*(?:\d+:\s*)?Error\s*(?:\([^)]*\):?)?:?\s*(?P<text>.*\S)\s*$"
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

#: Pairs of a CRIU message and its explanation; `\\1` stands for the first group.
_DUMP: Final = (
    (r"Can't dump file (\d+) of that type \[\w+\] \(\w+ (\d+:\d+)\)",
     r"its file descriptor \1 is the device \2, which cannot be dumped"),
    (r"Can't dump file (\d+) of that type \[\w+\] \(anon anon_inode:\[?(\w+)\]?\)",
     r"its file descriptor \1 is of the kind \2, which cannot be dumped"),
    (r"External socket is used", "it has a Unix socket that is connected to a process outside"),
    (r"with SysVIPC shmem map", "it uses System V shared memory, which belongs to the whole host"),
    (r"Unknown socket collected \(family (\d+)\)",
     r"it has a socket of address family \1, which cannot be dumped"),
    (r"pidfd pid (\d+) is not a part of process tree",
     r"it has a pidfd of the process \1, which is outside"),
    (r"Can't dump nested (\w+) namespace",
     r"a child of it lives in a \1 namespace of its own"),
    (r"Can't dump ghost file (\S+) of (\d+) size",
     r"it holds the deleted file \1 of \2 bytes open, which is too large to go along"),
    (r"Can't lookup mount=\d+ for fd=(-?\d+) path=([^\s;,]+)",
     r"the file \2 lies on a mount that cannot be seen from here"),
    (r"No space left on device", "the file system of the image is full"),
)  # fmt: skip
_RESTORE: Final = (
    (r"Can't bind inet socket.*Cannot assign requested address",
     "a socket of it is bound to a network address that this host does not have"),
    (r"Can't bind inet socket.*Address already in use",
     "the port of a socket of it is in use here, or by a listening socket of its own"),
    (r"Can't fork for (\d+): File exists",
     r"its pid \1 is in use here"),
    (r"Can't open file (\S+) on restore: (.*)", r"the file /\1 cannot be opened here: \2"),
    (r"File (\S+) has bad size (\d+) \(expect (\d+)\)",
     r"the file /\1 has \2 bytes here; the process knows it with \3"),
    (r"unix: .*Peer \d+ unresolved",
     "it had a Unix socket that was connected to a process outside"),
    (r"Read \d+ bytes while \d+ expected", "the image is damaged"),
    (r"No space left on device", "a file system is full here"),
)  # fmt: skip


def causes(log: str) -> tuple[str, ...]:
    """Return the lines of a log that explain CRIU's failure, first cause first, without repeats.

    Args:
        log: CRIU's log, or its output on standard error.
    """
    errors = [match["text"] for line in log.splitlines() if (match := _ERROR.match(line))]
    useful = [line for line in errors if not _EMPTY.fullmatch(line)] or errors
    return tuple(dict.fromkeys(useful))[:_MOST]


def first_words(output: str) -> tuple[str, ...]:
    """Return the first line of output that names no error: mostly a note on usage.

    Args:
        output: CRIU's standard output and error.
    """
    lines = (line.strip(" :") for line in output.splitlines())
    return tuple(line for line in lines if line and not line.startswith(("Warn", "(")))[:1]


def explain_dump(message: str) -> str:
    """Explain CRIU's message about a failed dump; return "" if the table does not have it."""
    return _meaning(message, _DUMP)


def explain_restore(message: str) -> str:
    """Explain CRIU's message about a failed restore; return "" if the table does not have it."""
    return _meaning(message, _RESTORE)


def _meaning(message: str, table: tuple[tuple[str, str], ...]) -> str:
    for pattern, meaning in table:
        match = re.search(pattern, message)
        if match is not None:
            return match.expand(meaning)
    return ""
