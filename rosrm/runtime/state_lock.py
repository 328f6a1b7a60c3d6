"""The directory in which a master or slave keeps its state: held by one of them at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from rosrm.errors import ConfigError, Refused


@contextlib.contextmanager
def only_one(directory: Path, role: str, *, code: str, remedy: str) -> Iterator[None]:
    """Hold a state directory for one process of a role on this machine.

    Args:
        directory: made where it is missing.
        role: "master" or "slave".
        code: of the refusal.
        remedy: settings with which a second one can run beside it; "": it cannot.

    Raises:
        Refused: another one holds it; the message names its pid.
        ConfigError: it cannot be used.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = (directory / f"{role}.lock").open("a+")
    except OSError as error:
        raise ConfigError(
            f"the state directory {directory} cannot be used: {error.strerror}; give this {role} "
            f"another `state:`"
        ) from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise Refused(
                f"a {role} runs already on {directory}: pid {lock.read().strip() or 'unknown'}. "
                f"Stop it first{remedy and f', or give this one {remedy}'}",
                code,
            ) from None
        with contextlib.suppress(OSError):  # a full disk: nobody will read who holds it
            os.ftruncate(lock.fileno(), 0)
            os.write(lock.fileno(), str(os.getpid()).encode())
        yield
