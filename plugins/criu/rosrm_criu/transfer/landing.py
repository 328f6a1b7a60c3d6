"""Temporary directory that collects a fetched directory and then becomes the target, atomically.

It is hidden, beside the target, and locked while its fetch lives. A killed fetch leaves one without
a lock, which the next fetch beside it removes.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rosrm.errors import TransferError
from rosrm.runtime.disk_space import room_for
from rosrm.shortage import names, status
from rosrm.wording import reason_of

_PREFIX: Final = ".rosrm-fetch-"


class StagingDirectory:
    """A new directory beside the target; it is removed at the end, unless it became the target.

    Args:
        target: a path that does not exist; its parent is created if it is missing.

    Attributes:
        path: directory to write to; accessible to its owner alone.

    Raises:
        TransferError: the target exists, or nothing can be created there.
    """

    def __init__(self, target: Path) -> None:
        self._target = target
        self._lock = -1
        parent = target.parent
        if status(target, follow_symlinks=False):
            raise TransferError(f"{target} exists already: nothing is fetched over it")
        try:
            parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with _locked(parent):
                _remove_stale(parent)
                self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
                self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
                fcntl.flock(self._lock, fcntl.LOCK_EX)
        except OSError as error:
            raise TransferError(f"nothing can be made in {parent}: {reason_of(error)}") from None

    def require(self, size: int, reserve: int) -> None:
        """Raise `TransferError` unless `size` bytes fit and leave `reserve` bytes free."""
        usage = os.statvfs(self.path)
        free = usage.f_bavail * usage.f_frsize
        if size + reserve > free:
            raise TransferError(
                f"{size} bytes do not fit beside {self._target}: {reserve} are to stay free, and "
                f"{room_for(self._target) or f'{free} are free'}"
            )

    def become_target(self) -> None:
        """Rename the directory to the target; raise `TransferError`."""
        try:
            self.path.rename(self._target)
        except OSError as error:
            raise TransferError(
                f"{self._target} cannot be put in its place: {reason_of(error)}"
            ) from None

    def close(self) -> None:
        """Remove the directory, unless it became the target."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Lock a directory; else a new one in it could be removed as stale before it is locked."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _remove_stale(parent: Path) -> None:
    for path in (parent / name for name in names(parent) if name.startswith(_PREFIX)):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:
            continue  # not ours
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue  # its fetch lives
        else:
            shutil.rmtree(path, ignore_errors=True)
        finally:
            os.close(descriptor)
