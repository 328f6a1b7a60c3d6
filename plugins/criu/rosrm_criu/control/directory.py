"""A control directory, as everybody opens it: no link is followed, neither to it nor in it.

It may belong to another user than the one who writes there, and that may be root: a link in the
place of a file or directory would have it write, give away or remove what it leads to. So each part
of the path is opened in the one before it, by descriptors. Standard library alone.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rosrm.errors import PortableError

_DIRECTORY: Final = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
#: To go on from, where nothing may be read.
_WAY: Final = os.O_PATH | _DIRECTORY


@contextlib.contextmanager
def opened(directory: Path) -> Iterator[int]:
    """A descriptor of it; raises `OSError`, also where a link lies on the way."""
    with contextlib.ExitStack() as way:
        here = _go(way, "/")
        for name in directory.absolute().parts[1:]:
            here = _go(way, name, here)
        yield here


def make(directory: Path, owner: int) -> None:
    """Make it, and what is missing above it, where nobody but its owner can write.

    Args:
        directory: absolute; what is made is readable by its owner alone.
        owner: the user whose it is to be.

    Raises:
        OSError: it cannot be made.
        PortableError: something on the way is no directory, somebody else's, or open to all.
    """
    with contextlib.ExitStack() as way:
        here, path = _go(way, "/"), Path("/")
        _check(path, here, owner)
        for name in directory.absolute().parts[1:]:
            path /= name
            try:
                here = _go_or_make(way, name, here, owner)
            except NotADirectoryError:
                raise PortableError(f"{path} is no directory{_advice(owner)}") from None
            _check(path, here, owner)


def remove(directory: Path) -> None:
    """Remove it, and the files in it, as far as that can be done."""
    with contextlib.suppress(OSError):
        with opened(directory) as here:
            listing = os.open(".", os.O_RDONLY | _DIRECTORY, dir_fd=here)
            try:
                for name in os.listdir(listing):  # noqa: PTH208 - a path could lead elsewhere
                    with contextlib.suppress(OSError):
                        os.unlink(name, dir_fd=listing)
            finally:
                os.close(listing)
        with opened(directory.parent) as above:
            os.rmdir(directory.name, dir_fd=above)


def _go(way: contextlib.ExitStack, name: str, above: int | None = None, flags: int = _WAY) -> int:
    descriptor = os.open(name, flags, dir_fd=above)
    way.callback(os.close, descriptor)
    return descriptor


def _go_or_make(way: contextlib.ExitStack, name: str, above: int, owner: int) -> int:
    with contextlib.suppress(FileNotFoundError):
        return _go(way, name, above)
    with contextlib.suppress(FileExistsError):  # somebody else makes it just now
        os.mkdir(name, 0o700, dir_fd=above)
    new = _go(way, name, above, os.O_RDONLY | _DIRECTORY)
    if owner != os.fstat(new).st_uid == os.geteuid():
        os.fchown(new, owner, -1)
    return new


def _check(path: Path, descriptor: int, owner: int) -> None:
    """Who may write there could have a node leave: nobody but its owner and root may."""
    state = os.fstat(descriptor)
    open_to_all = state.st_mode & stat.S_IWOTH and not state.st_mode & stat.S_ISVTX
    if state.st_uid not in {0, owner, os.geteuid()} or open_to_all:
        raise PortableError(f"{path} is of user {state.st_uid}, or open to all{_advice(owner)}")


def _advice(owner: int) -> str:
    return (
        f"; a node of user {owner} is asked to move only where no one else can write: remove it, "
        f"or correct its owner and mode"
    )
