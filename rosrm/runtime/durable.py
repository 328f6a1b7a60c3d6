"""Functions that write state. The name of each one says what its result survives.

*Atomically* survives a kill: whenever the process ends, a reader finds the old content or the new
one. After a loss of power the content of the last half minute may be missing; a file that is new
since then may be empty, although its name, mode and time are there.

*Durably* survives the loss of power: what the function has written and named is on the disk when it
returns. It may take as long as the disk needs, seconds on a busy one, so no loop that keeps a lease
calls it. Such a loop runs in `lease_kept_here`, and a sync in it is logged as an error.
"""

# ruff: noqa: TID251 - the one place of syncs

from __future__ import annotations

import _thread  # `threading` costs the supervisor 300 KiB
import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from rosrm.runtime.private_files import open_private, write_all

#: Errors of a file, such as the output, that takes no more data: a full disk, a quota, a limit of
#: the size of files, a disk that fails or is read-only.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
#: Mode that `open_private` gives.
_PRIVATE: Final = 0o600
#: Most threads that force files to the disk together.
_AT_ONCE: Final = 16
#: Error of a sync that a loop must not wait for; the tests look for it in the logs of all parts.
SYNC_IN_LOOP: Final = "waits for the disk in the loop that keeps a lease"
#: Threads that keep a lease, by number, and the places of syncs in them.
_lease_threads: Final[set[int]] = set()
_logged: Final[set[str]] = set()


@contextlib.contextmanager
def lease_kept_here() -> Iterator[None]:
    """Mark the calling thread as one that keeps a lease until the context ends.

    It sends beats or readings. If it waited for a slow disk, its peers would take it for lost.
    """
    number = _thread.get_ident()
    _lease_threads.add(number)
    try:
        yield
    finally:
        _lease_threads.discard(number)


def check_thread() -> None:
    """Log an error, once for each place, if the calling thread keeps a lease; called before a sync.

    The sync is not refused: a late beat does less harm than a promise that was not kept.
    """
    if _thread.get_ident() not in _lease_threads:
        return
    frame = sys._getframe(1)  # noqa: SLF001 - the place of the caller
    while frame.f_back is not None and frame.f_code.co_filename in (__file__, contextlib.__file__):
        frame = frame.f_back
    place = f"{frame.f_code.co_filename}:{frame.f_lineno}"
    if place not in _logged:
        _logged.add(place)
        import logging  # noqa: PLC0415 - a bug is rare, and memory is budgeted

        logging.getLogger("rosrm").error("%s %s: report this as a bug", place, SYNC_IN_LOOP)


def replace_atomically(path: str, content: bytes, flags: int = 0, mode: int = _PRIVATE) -> int:
    """Replace a file by a new one, and return the open descriptor of the new one.

    After a failure the old file is unchanged, and no part of the new content is left: it would
    take the room that a full disk no longer has.

    Args:
        path: of the file; the new content is first written to a file beside it.
        content: of the new file.
        flags: further flags of its descriptor.
        mode: of the new file.

    Raises:
        OSError: the file cannot be written.
    """
    new = f"{path}.new"
    file = _written(new, content, flags, mode)
    try:
        os.replace(new, path)
    except OSError:
        with contextlib.suppress(OSError):  # the first fault is the reason
            os.close(file)
        with contextlib.suppress(OSError):
            os.unlink(new)
        raise
    return file


def replace_durably(path: str, content: bytes) -> None:
    """Replace a file, as `replace_atomically`, and force the new one and its name to the disk.

    Raises:
        OSError: the file cannot be written. If its name cannot be forced to the disk, the new
            content is there nevertheless.
    """
    with prepared(path, content) as replace:
        replace()


@contextlib.contextmanager
def prepared(path: str, content: bytes) -> Iterator[Callable[[], None]]:
    """Force a new file to the disk; yield the function that puts it in the place of a file.

    Without a call of the function the file is unchanged, and no part of the new one is left. The
    function raises `OSError` as `replace_durably`.

    Raises:
        OSError: the new file cannot be written.
    """
    new = f"{path}.new"
    os.close(_written(new, content))
    try:
        _sync_file(new)
        yield partial(_give_name, new, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(new)


def replace_all_durably(contents: Mapping[str, bytes]) -> dict[str, OSError]:
    """Replace files, each as `replace_durably`, in about the time of one of them.

    Args:
        contents: path to new content.

    Returns:
        Path to the reason why a file was not replaced, or its name not forced to the disk.
    """
    faults: dict[str, OSError] = {}
    written = {path: f"{path}.new" for path in contents}

    def attempt(work: Callable[[str], object]) -> None:
        for path in contents.keys() - faults.keys():
            try:
                work(path)
            except OSError as error:
                faults[path] = error

    attempt(lambda path: os.close(_written(written[path], contents[path])))
    unwritten = set(faults)
    whole = _together(_sync_file, [written[path] for path in contents.keys() - unwritten])
    faults |= {path: whole[new] for path, new in written.items() if new in whole}
    attempt(lambda path: os.replace(written[path], path))
    for path in faults.keys() - unwritten:
        with contextlib.suppress(OSError):
            os.unlink(written[path])
    folders = {path: os.path.dirname(path) for path in contents.keys() - faults.keys()}
    named = _together(sync_directory, list(set(folders.values())))
    return faults | {path: named[one] for path, one in folders.items() if one in named}


def append_durably(path: str, content: bytes) -> None:
    """Append to a file that exists, and force the content to the disk.

    Raises:
        OSError: the file cannot be written, and may have a beginning of the content; or the content
            cannot be forced to the disk, and the file has none of it.
    """
    file = open_private(path, os.O_WRONLY | os.O_APPEND)
    try:
        size = os.fstat(file).st_size
        write_all(file, content)
        try:
            check_thread()
            os.fdatasync(file)
        except OSError:
            with contextlib.suppress(OSError):  # the first fault is the reason
                os.ftruncate(file, size)
            raise
    finally:
        os.close(file)


def rename_durably(source: str, target: str) -> None:
    """Force a file, or a directory with all that is in it, to the disk; then give it its name.

    Raises:
        OSError: it cannot be read, forced to the disk or renamed.
    """
    sync(source)
    os.rename(source, target)
    sync_directory(os.path.dirname(target))


def sync(path: str) -> None:
    """Force a file, or a directory with all that is in it, to the disk; raises `OSError`."""
    if not os.path.isdir(path):
        _sync_file(path)
        return
    folders, files = [], []
    for folder, _, names in os.walk(path, onerror=_fail):
        folders.append(folder)
        files += [os.path.join(folder, name) for name in names]
    regular = [file for file in files if not os.path.islink(file)]
    for fault in (_together(_sync_file, regular) | _together(sync_directory, folders)).values():
        raise fault


def sync_directory(path: str) -> None:
    """Force the names in a directory to the disk; raises `OSError`.

    Some network file systems cannot do so for a directory; they keep names by other means.
    """
    directory = os.open(path or ".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _force(directory)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(directory)


def _give_name(new: str, path: str) -> None:
    os.replace(new, path)
    sync_directory(os.path.dirname(path))


def _together(force: Callable[[str], None], paths: Sequence[str]) -> dict[str, OSError]:
    """Force files or directories to the disk, many at a time; return the reasons of failures.

    A file system writes in one pass what several threads ask for: on ext4, 200 files took 0.03 s
    so, and 0.5 s one after the other. `syncfs` would also wait for the data of all other programs.
    """
    check_thread()
    faults: dict[str, OSError] = {}
    left = iter(paths)

    def work() -> None:
        for path in left:  # each thread takes the next one
            try:
                force(path)
            except OSError as error:
                faults[path] = error

    helpers = []
    if len(paths) > 1:
        from rosrm import threads  # noqa: PLC0415 - the supervisor, which is small, forces nothing

        with contextlib.suppress(RuntimeError):  # no further thread: this one does all
            for _ in range(min(len(paths), _AT_ONCE) - 1):
                helpers.append(threads.start(work, "syncs"))  # noqa: PERF401 - some may start
    work()
    for helper in helpers:
        helper.join()
    return faults


def _written(path: str, content: bytes, flags: int = 0, mode: int = _PRIVATE) -> int:
    """Write a file, and return its descriptor; a failure leaves nothing of it.

    A FIFO or link in its place is refused, and stays.
    """
    file = open_private(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | flags)
    try:
        if mode != _PRIVATE:
            os.fchmod(file, mode)
        write_all(file, content)
    except BaseException:  # also an interrupt must leave no part of it
        with contextlib.suppress(OSError):  # the first fault is the reason
            os.close(file)
        with contextlib.suppress(OSError):
            os.unlink(path)
        raise
    return file


def _sync_file(path: str) -> None:
    file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        _force(file)
    finally:
        os.close(file)


def _force(file: int) -> None:
    check_thread()
    os.fsync(file)


def _fail(error: OSError) -> None:
    raise error
