"""Safe access to a control directory: no symbolic link is followed, neither on the path nor inside.

The directory may belong to another user than the writer, and the writer may be root. Through a
link, root would write, chown or remove the link's target. So each part of the path is opened by
file descriptor, relative to the one before. Standard library only.
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
#: Opens a directory only to descend from it; works without read permission.
_WAY: Final = os.O_PATH | _DIRECTORY


@contextlib.contextmanager
def opened(directory: Path) -> Iterator[int]:
    """Yield a descriptor of a directory; raise `OSError`, also for a symbolic link on the path."""
    with contextlib.ExitStack() as way:
        here = _go(way, "/")
        for name in directory.absolute().parts[1:]:
            here = _go(way, name, here)
        yield here


def make(directory: Path, owner: int) -> None:
    """Create a directory and its missing parents, writable by their owner alone.

    Args:
        directory: an absolute path; new directories are readable by their owner alone.
        owner: uid of the user who is to own them.

    Raises:
        OSError: a directory cannot be created.
        PortableError: part of the path is no directory, belongs to another user, or is writable by
            everyone.
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


def remove_directory(directory: Path) -> None:
    """Remove a directory and the files in it; ignore errors."""
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
    with contextlib.suppress(FileExistsError):  # another process creates it at the same time
        os.mkdir(name, 0o700, dir_fd=above)
    new = _go(way, name, above, os.O_RDONLY | _DIRECTORY)
    if owner != os.fstat(new).st_uid == os.geteuid():
        os.fchown(new, owner, -1)
    return new


def _check(path: Path, descriptor: int, owner: int) -> None:
    """Raise `PortableError` unless only owner and root can write: writers can make a node leave."""
    state = os.fstat(descriptor)
    open_to_all = state.st_mode & stat.S_IWOTH and not state.st_mode & stat.S_ISVTX
    if state.st_uid not in {0, owner, os.geteuid()} or open_to_all:
        raise PortableError(f"{path} is of user {state.st_uid}, or open to all{_advice(owner)}")


def _advice(owner: int) -> str:
    return (
        f"; a node of user {owner} is asked to move only where no one else can write: remove it, "
        f"or correct its owner and mode"
    )
