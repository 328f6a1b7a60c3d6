"""For who moves a node: ask it to leave the ROS graph or to join it again, and await that.

The node finds its directory by a path that is fixed when its process starts, and keeps it through a
move: at another host the very same path has to exist (`make_directory`) before it is restored.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final

from rosrm.errors import PortableError
from rosrm.supervisor.procfs import read_environment
from rosrm_criu.control.directory import make, remove
from rosrm_criu.control.messages import (
    SIGNAL,
    VARIABLE,
    Request,
    State,
    Status,
    Want,
    read_status,
    remove_request,
    remove_status,
    write_request,
)

#: Seconds between two looks at a status: the standard library cannot await the change of a file.
_LOOK: Final = 0.005


def control_root(uid: int) -> Path:
    """The directory of all control directories of a user: a path that every host can make."""
    return Path(f"/tmp/rosrm-{uid}/portable")  # noqa: S108 - owner and mode are checked


def control_directory(token: str, uid: int) -> Path:
    """Where the node of one instance is spoken to.

    Args:
        token: of the instance, unique on all hosts that share this /tmp; a plain file name.
        uid: of the user that the process runs as.
    """
    if not token or "/" in token or token.startswith("."):
        raise PortableError(f"{token!r} cannot name a control directory: a plain file name can")
    return control_root(uid) / token


def directory_of(pid: int) -> Path | None:
    """Where the node of a process is spoken to, as it was told at its start; None: nowhere.

    Raises:
        OSError: it has ended, or is not ours to look at.
    """
    mark = f"{VARIABLE}=".encode()
    variables = read_environment(pid)
    named = next((word[len(mark) :] for word in variables if word.startswith(mark)), b"")
    return Path(os.fsdecode(named)) if named else None


def make_directory(directory: Path, uid: int | None = None) -> None:
    """Make a control directory, before a process starts or is restored; nothing of it remains.

    Args:
        directory: absolute; readable by its owner alone. Of another user it has to be one of
            `control_directory`: a process says by itself where it is spoken to.
        uid: whose it is to be; None: our own.

    Raises:
        PortableError: it cannot be made, or is somebody else's.
    """
    owner = os.geteuid() if uid is None else uid
    if owner != os.geteuid() and directory != control_directory(directory.name, owner):
        raise PortableError(
            f"{directory} is no control directory of user {owner}: these are in "
            f"{control_root(owner)}"
        )
    try:
        make(directory, owner)
    except OSError as error:
        raise PortableError(
            f"the control directory {directory} cannot be made: {error.strerror}"
        ) from None
    remove_status(directory)
    remove_request(directory)  # nobody asks before there is a status


def remove_directory(directory: Path) -> None:
    """Nobody is spoken to there any more."""
    remove(directory)


def status_of(directory: Path) -> Status | None:
    """How the node stands; None: no portable node runs there (yet). Raises `PortableError`."""
    return read_status(directory)


def ask_prepare(directory: Path, pid: int | None, request_id: str) -> None:
    """Ask a running node to leave the ROS graph. The same request a second time does nothing.

    Args:
        directory: its control directory.
        pid: its process, which is woken; None: it looks by itself, four times a second.
        request_id: of this attempt to move it; never used before.

    Raises:
        PortableError: it cannot be asked: what to do is said.
    """
    status = _status_to_ask(directory)
    if status.state is State.FAILED:
        raise PortableError(f"the node has failed: {status.fault}")
    _ask(directory, pid, Request(request_id, Want.LEAVE))


def ask_resume(directory: Path, pid: int | None, request_id: str) -> None:
    """Ask a node that has left to join again; one that has not left yet, to stay.

    It may be asked before it is restored (`pid` None): then it joins as soon as it runs.

    Args:
        directory: its control directory; at another host the path is the same.
        pid: its process, which is woken; None: it looks by itself, twenty times a second.
        request_id: with which it was asked to leave.

    Raises:
        PortableError: it cannot be asked: what to do is said.
    """
    _ask(directory, pid, Request(request_id, Want.JOIN))


def await_left(directory: Path, request_id: str, timeout: float, pid: int | None = None) -> Status:
    """Wait until a node has left: no ROS is in it any more, it can be dumped.

    Args:
        directory: its control directory.
        request_id: of `ask_prepare`.
        timeout: seconds.
        pid: its process; it is not waited for when that has ended.

    Raises:
        PortableError: it refused, failed, was called back, or the time passed.
    """
    status = _await(directory, request_id, State.LEFT, timeout, pid)
    if status.state is State.LEFT:
        return status
    if status.fault:
        raise PortableError(f"the node does not leave the ROS graph: {status.fault}")
    raise PortableError(
        f"the node was asked to stay (request {request_id}) before it could be awaited that it left"
    )


def await_joined(
    directory: Path, request_id: str, timeout: float, pid: int | None = None
) -> Status:
    """Wait until a node runs again in the ROS graph.

    Args:
        directory: its control directory.
        request_id: of `ask_resume`.
        timeout: seconds.
        pid: its process; it is not waited for when that has ended.

    Raises:
        PortableError: it failed, or the time passed.
    """
    status = _await(directory, request_id, State.RUNNING, timeout, pid)
    if status.state is State.FAILED:
        raise PortableError(f"the node cannot join the ROS graph again: {status.fault}")
    return status


def _status_to_ask(directory: Path) -> Status:
    status = read_status(directory)
    if status is None:
        raise PortableError(
            f"no portable node has joined in {directory}: its program does not use "
            f"rosrm_criu.node.run_portable, or has not come so far yet"
        )
    return status


def _ask(directory: Path, pid: int | None, request: Request) -> None:
    if pid is not None:
        _check_catches(pid)
    try:
        write_request(directory, request)
    except OSError as error:
        raise PortableError(f"{directory} cannot be written: {error.strerror}") from None
    if pid is not None:
        try:
            os.kill(pid, SIGNAL)
        except OSError as error:
            raise PortableError(f"process {pid} cannot be woken: {error.strerror}") from None


def listens(pid: int) -> bool:
    """Whether a process waits to be asked; one that has ended does not."""
    try:
        _check_catches(pid)
    except PortableError:
        return False
    return True


def _check_catches(pid: int) -> None:
    """A process that neither catches the signal nor awaits it would be ended by it.

    Who holds a restored process blocks all signals, and passes them on.
    """
    status = _of_process(pid)
    safe = int(status.get("SigCgt", "0"), 16) | int(status.get("SigBlk", "0"), 16)
    if not safe >> (SIGNAL - 1) & 1:
        raise PortableError(
            f"process {pid} does not catch signal {SIGNAL}, so it is no portable node (or a "
            f"program around one: start the node itself); it was not asked"
        )


def _of_process(pid: int) -> dict[str, str]:
    """Lines of /proc/PID/status; raises `PortableError` when the process has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8", errors="replace")
    except OSError:
        raise PortableError(f"process {pid} has ended") from None
    found = dict(line.split(":\t", 1) for line in lines.splitlines() if ":\t" in line)
    if found.get("State", "")[:1] in "ZX":
        raise PortableError(f"process {pid} has ended")
    return {name: value.strip() for name, value in found.items()}


def _await(
    directory: Path, request_id: str, wanted: State, timeout: float, pid: int | None
) -> Status:
    """The first status that answers a request, or is final."""
    deadline = time.monotonic() + timeout
    while True:
        status = read_status(directory)
        if status is not None and _is_answer(status, request_id, wanted):
            return status
        if pid is not None:
            _of_process(pid)
        if time.monotonic() >= deadline:
            raise PortableError(_why_not(directory, request_id, wanted, timeout, pid, status))
        time.sleep(_LOOK)


def _is_answer(status: Status, request_id: str, wanted: State) -> bool:
    if status.state is State.FAILED:
        return True
    if status.request != request_id:
        return False
    # RUNNING answers who awaits that it left, too: it was refused, or called back.
    return status.state in (wanted, State.RUNNING)


def _why_not(
    directory: Path, request_id: str, wanted: State, timeout: float, pid: int | None,
    status: Status | None,
) -> str:  # fmt: skip
    what = "left the ROS graph" if wanted is State.LEFT else "joined the ROS graph again"
    return (
        f"the node has not {what} within {timeout:g} s (request {request_id}, {directory}): "
        f"{_standing(request_id, status)}{_doing(pid)}"
    )


def _standing(request_id: str, status: Status | None) -> str:
    if status is None:
        return "it says nothing"
    if status.request == request_id:
        return f"it is {status.state.value}"
    return f"it is {status.state.value} and has not taken the request up"


def _doing(pid: int | None) -> str:
    """What keeps it, as far as that can be seen from outside."""
    if pid is None:
        return ""
    if _of_process(pid).get("State", "")[:1] in "tT":
        return f"; process {pid} is stopped (SIGSTOP): continue it, or end it"
    return f"; process {pid} runs: a callback may be taking its time"
