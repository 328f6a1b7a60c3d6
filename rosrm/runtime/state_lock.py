"""Lock of the state directory of a master or slave: one process holds it at a time."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from rosrm.errors import ConfigError, Refused
from rosrm.runtime.private_files import make_private_directory, open_private

_log = logging.getLogger("rosrm")


@contextlib.contextmanager
def only_one(directory: Path, role: str, *, code: str, remedy: str) -> Iterator[None]:
    """Lock a state directory for one process of a role on this machine.

    Args:
        directory: created if it is missing; an existing one that is open to others is tightened.
        role: "master" or "slave".
        code: error code of the refusal.
        remedy: settings that allow a second process beside the first; "" if none do.

    Raises:
        Refused: another process holds the directory; the message names its pid.
        ConfigError: the directory cannot be used.
    """
    try:
        former = make_private_directory(directory)
        lock = os.fdopen(
            open_private(str(directory / f"{role}.lock"), os.O_RDWR | os.O_CREAT), "r+"
        )
    except OSError as error:
        raise ConfigError(
            f"the state directory {directory} cannot be used: {error.strerror}; give this {role} "
            f"another `state:`"
        ) from None
    if former:
        _log.warning(
            "the state directory %s had mode %04o, open to other users; it has 0700 now",
            directory, former,
        )  # fmt: skip
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Refused(
                f"a {role} runs already on {directory}: pid {lock.read().strip() or 'unknown'}. "
                f"Stop it first{remedy and f', or give this one {remedy}'}",
                code,
            ) from None
        with contextlib.suppress(OSError):  # a full disk: only a refusal's message lacks the pid
            os.ftruncate(lock.fileno(), 0)
            os.write(lock.fileno(), str(os.getpid()).encode())
        yield
