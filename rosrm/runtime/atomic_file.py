"""Replacement of a whole file, for a reader that must never see a part of the new content."""

from __future__ import annotations

import contextlib
import errno
import os
from typing import Final

from rosrm.runtime.private_files import open_private, write_all

#: Errors of a file, such as the output, that takes no more data: a full disk, a quota, a limit of
#: the size of files, a disk that fails or is read-only.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
#: Mode that `open_private` gives.
_PRIVATE: Final = 0o600


def replace(
    path: str, content: bytes, flags: int = 0, mode: int = _PRIVATE, *, is_durable: bool = False
) -> int:
    """Replace a file by a new one, and return the open descriptor of the new one.

    After a failure the old file is unchanged, and no part of the new content is left: it would
    take the room that a full disk no longer has.

    Args:
        path: of the file; the new content is first written to a file beside it.
        content: of the new file.
        flags: further flags of its descriptor.
        mode: of the new file.
        is_durable: the new file is on the disk before it replaces the old one.

    Raises:
        OSError: the file cannot be written.
    """
    new = f"{path}.new"
    file = open_private(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | flags)
    try:
        if mode != _PRIVATE:
            os.fchmod(file, mode)
        write_all(file, content)
        if is_durable:
            os.fsync(file)
        os.replace(new, path)
    except OSError:
        with contextlib.suppress(OSError):  # the first fault is the reason
            os.close(file)
        with contextlib.suppress(OSError):
            os.unlink(new)
        raise
    return file
