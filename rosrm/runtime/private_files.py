"""Directories and files for one user: owner, mode and links are checked before they are used.

A state directory holds environments and parameters of processes, which may contain passwords, and
files that rosrm truncates. Another user who could write there, or on the way to it, would make
rosrm read or truncate any file of its user. The supervisor imports this module: it stays small.
"""

from __future__ import annotations

import errno
import grp
import os
import pwd
import stat
from typing import Final

_OTHERS: Final = 0o077
_SHARED: Final = frozenset({"/tmp", "/var/tmp", "/dev/shm"})  # noqa: S108 - never used
_user_umask = -1


def set_private_umask() -> None:
    """Keep all files that this process creates from group and others."""
    global _user_umask  # noqa: PLW0603 - an attribute of the process
    _user_umask = os.umask(_OTHERS)


def user_umask() -> int:
    """Return the umask for the processes of users; -1: that of this process."""
    return _user_umask


def make_private_directory(directory: str | os.PathLike[str]) -> int:
    """Create a directory for its owner alone, or tighten the mode of an existing one to 0700.

    Returns:
        The former mode of a directory that was open to group or others; 0: it was not.

    Raises:
        OSError: it cannot be created or used; `strerror` says why, and what is allowed.
    """
    path = os.path.abspath(directory)
    make_safe_directory(os.path.dirname(path))
    _make(path)
    state = os.lstat(path)
    if stat.S_ISLNK(state.st_mode):
        raise _refusal(path, f"it is a symbolic link; name its target, {os.path.realpath(path)}")
    _check_directory(path, state)
    _check_owner(path, state)
    mode = stat.S_IMODE(state.st_mode)
    if not mode & _OTHERS:
        return 0
    if path in _SHARED:
        raise _refusal(path, "all users share it; name a directory below it")
    os.chmod(path, 0o700)
    return mode


def make_safe_directory(directory: str | os.PathLike[str]) -> None:
    """Create a directory and its missing parents, where no other user can replace them.

    Raises:
        OSError: a part of the path cannot be created, belongs to another user than root, or is
            writable for all users or a group of several without the sticky bit; `strerror` says
            which.
    """
    path = os.path.abspath(directory)
    above = os.path.dirname(path)
    if above != path:
        make_safe_directory(above)
    _make(path)
    state = os.lstat(path)
    trusted = {0, os.geteuid(), os.stat("/").st_uid}  # the last: root outside a user namespace
    if state.st_uid not in trusted:
        raise _refusal(path, f"{path} belongs to user {state.st_uid}, who could replace it")
    if stat.S_ISLNK(state.st_mode):
        os.stat(path)  # raises for a loop of links
        make_safe_directory(os.path.realpath(path))
        return
    _check_directory(path, state)
    if state.st_mode & stat.S_ISVTX:
        return
    if state.st_mode & stat.S_IWOTH:
        raise _refusal(
            path, f"{path} is writable for all users, who could replace it (`chmod o-w {path}`)"
        )
    if state.st_mode & stat.S_IWGRP and not _is_private_group(state):
        raise _refusal(
            path,
            f"{path} is writable for the group {state.st_gid}, whose members could replace it "
            f"(`chmod g-w {path}`)",
        )


def _is_private_group(state: os.stat_result) -> bool:
    """Return True if only the owner of a directory is in its group, as Debian sets up each user."""
    try:
        group, owner = grp.getgrgid(state.st_gid), pwd.getpwuid(state.st_uid)
    except KeyError:
        return False
    return group.gr_name == owner.pw_name and {*group.gr_mem} <= {owner.pw_name}


def open_private(path: str, flags: int) -> int:
    """Open or create a regular file of this user, with mode 0600; never follow a link.

    With O_TRUNC the file is emptied only after these checks.

    Raises:
        OSError: it cannot be opened, is a link, or belongs to another user.
    """
    file, mode = open_own(path, flags & ~os.O_TRUNC)
    try:
        if mode & _OTHERS:
            os.fchmod(file, 0o600)
        if flags & os.O_TRUNC:
            os.ftruncate(file, 0)
    except OSError:
        os.close(file)
        raise
    return file


def open_own(path: str, flags: int) -> tuple[int, int]:
    """Open a regular file of this user as it is; never follow a link.

    Returns:
        The descriptor, and the mode of the file, which others may be allowed to read.

    Raises:
        OSError: it cannot be opened, is a link, or belongs to another user.
    """
    try:
        # Without waiting: the path may have become a FIFO, which `_check_file` refuses.
        kept = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        file = os.open(path, flags | kept, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _refusal(path, "it is a symbolic link") from None
        if error.errno == errno.ENXIO:
            raise _refusal(path, "it is no regular file") from None
        raise
    try:
        state = os.fstat(file)
        _check_file(path, state)
    except OSError:
        os.close(file)
        raise
    return file, stat.S_IMODE(state.st_mode)


def write_all(file: int, content: bytes) -> None:
    """Write bytes to a descriptor, as one call of `os.write` may write only a part of them.

    Raises:
        OSError: the disk is full, for example; a part may have been written.
    """
    view = memoryview(content)
    while view:
        view = view[os.write(file, view) :]


def make_private_file(path: str) -> None:
    """Tighten the mode of a file in a private directory to 0600; a missing file is no error.

    The file is not opened: closing a second descriptor would release the locks of SQLite.

    Raises:
        OSError: it is a link, or belongs to another user.
    """
    try:
        state = os.lstat(path)
    except FileNotFoundError:
        return
    _check_file(path, state)
    if state.st_mode & _OTHERS:
        os.chmod(path, 0o600)


def _make(path: str) -> None:
    try:
        os.mkdir(path, 0o700)
    except OSError:
        if not os.path.lexists(path):  # e.g. EROFS comes before EEXIST
            raise


def _check_directory(path: str, state: os.stat_result) -> None:
    if not stat.S_ISDIR(state.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), path)


def _check_file(path: str, state: os.stat_result) -> None:
    if stat.S_ISDIR(state.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), path)
    if stat.S_ISLNK(state.st_mode):
        raise _refusal(path, "it is a symbolic link")
    if not stat.S_ISREG(state.st_mode):
        raise _refusal(path, "it is no regular file")
    _check_owner(path, state)


def _check_owner(path: str, state: os.stat_result) -> None:
    if state.st_uid != os.geteuid():
        raise _refusal(path, f"it belongs to user {state.st_uid}, and this is user {os.geteuid()}")


def _refusal(path: str, reason: str) -> PermissionError:
    return PermissionError(errno.EPERM, reason, path)
