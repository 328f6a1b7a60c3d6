"""Both ends of `supervisor.sock`, and the lock that admits one supervisor to a state directory."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
from typing import Final

from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.supervisor import own_log, paths
from rosrm.wording import reason_of

#: First words of the error for a state directory that is served already.
ANOTHER: Final = "another supervisor"
#: Bytes of the pid in the lock.
_PID_BYTES: Final = 20
#: Least seconds for a connection; a limit of 0 would mean none.
_SHORTEST: Final = 0.001


class EndpointError(Exception):
    """The state directory cannot be served; the text gives the reason."""


def listen(state: str) -> socket.socket:
    """Lock the state directory and return the listening socket. Raises EndpointError."""
    try:
        make_private_directory(state)
        for folder in (paths.log_folder(state), paths.work_directory(state)):
            os.makedirs(folder, mode=0o700, exist_ok=True)  # the owner may link them elsewhere
        _lock(state)
        return _bind(state)
    except OSError as error:
        reason = reason_of(error)
        raise EndpointError(f"the state directory {state} cannot be used: {reason}") from None


def connect(state: str, timeout: float) -> socket.socket:
    """Connect to the supervisor of a state directory.

    Args:
        state: the directory.
        timeout: seconds.

    Raises:
        TimeoutError: a supervisor listens and accepts no connection, because it is stopped.
        OSError: none listens.
    """
    directory = os.open(state, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # Clients that gave up stay in the queue of a stopped supervisor. Once the queue is full,
        # the kernel makes a connect wait like a send.
        _limit_sends(peer, max(timeout, _SHORTEST))
        peer.connect(_short_path(directory))
        _limit_sends(peer, 0.0)
    except BlockingIOError:
        peer.close()
        raise TimeoutError(f"{state}: connection not accepted within {timeout:g} s") from None
    except OSError:
        peer.close()
        raise
    finally:
        os.close(directory)
    return peer


def _limit_sends(peer: socket.socket, seconds: float) -> None:
    """Limit the time of a blocking call that sends; 0: no limit."""
    whole = int(seconds)
    limit = struct.pack("ll", whole, int((seconds - whole) * 1e6))
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


def let_go_of_terminal(state: str) -> None:
    """Write "ready" to standard output, then redirect all errors to the supervisor's own log."""
    os.write(1, b"ready\n")
    path = os.path.join(state, paths.OWN_LOG)
    null = os.open(os.devnull, os.O_RDWR)
    try:
        log = open_private(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        if os.fstat(log).st_size > own_log.MOST_BYTES:
            os.ftruncate(log, 0)
    except OSError:  # a full or read-only disk: better no log than no supervisor
        log = os.dup(null)
    for source, target in ((null, 0), (null, 1), (log, 2)):
        os.dup2(source, target)
    os.close(null)
    os.close(log)


def _lock(state: str) -> None:
    """Hold the lock until the process ends; the kernel releases it, even after a SIGKILL."""
    global _lock_file  # noqa: PLW0603 - of the one lock
    file = open_private(os.path.join(state, paths.LOCK), os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(file, _PID_BYTES).decode().strip() or "unknown"
        raise EndpointError(
            f"{ANOTHER} (pid {holder}) serves the state directory {state}"
        ) from None
    # In place: on a full disk the room of a shortened file may be taken at once.
    os.pwrite(file, f"{os.getpid()}\n".ljust(_PID_BYTES).encode(), 0)
    _lock_file = file


_lock_file = -1


def release_lock() -> None:
    """Release the lock of `listen`, for a process whose end a disk may delay."""
    os.close(_lock_file)


def _bind(state: str) -> socket.socket:
    path = os.path.join(state, paths.SOCKET)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)  # left by a killed supervisor, because this process holds the lock
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    directory = os.open(state, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    umask = os.umask(0o177)
    try:
        listener.bind(_short_path(directory))
    finally:
        os.umask(umask)
        os.close(directory)
    listener.listen(16)
    listener.setblocking(False)
    return listener


def _short_path(directory: int) -> str:
    """Return a short path: a socket's path holds 108 bytes; a state directory's may be longer."""
    return f"/proc/self/fd/{directory}/{paths.SOCKET}"
