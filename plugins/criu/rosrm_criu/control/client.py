"""Client side of a control directory: request graph departure or rejoin, and await the result.

The path of the directory is fixed when the node's process starts, and a move keeps it. So the same
path must exist on the destination (`make_directory`) before the process is restored there.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import PortableError
from rosrm.runtime.signalling import send
from rosrm.shortage import is_directory
from rosrm.supervisor.procfs import read_environment
from rosrm.wording import reason_of
from rosrm_criu.control.directory import make
from rosrm_criu.control.messages import (
    SIGNAL,
    VARIABLE,
    Request,
    State,
    Status,
    Want,
    read_message,
    remove_messages,
    write_message,
)

#: Seconds between two reads of a status file; the standard library cannot wait for a file change.
_LOOK: Final = 0.002


#: Made by an administrator or a service manager on all hosts, if at all; see `control_roots`.
_SERVICE: Final = Path("/run/rosrm")


def control_root(uid: int) -> Path:
    """Return the usual parent of the control directories of a user; every host can create it."""
    return Path(f"/tmp/rosrm-{uid}/portable")  # noqa: S108 - owner and mode are checked


def control_roots(uid: int) -> tuple[Path, ...]:
    """Return all parents that control directories of a user may have, the preferred one first.

    The path of a node stays the same on all hosts that it moves to. So a directory that only exists
    during a login comes after /tmp, where another user may have taken the name.
    """
    return (
        _SERVICE / str(uid) / "portable",
        control_root(uid),
        Path(f"/run/user/{uid}/rosrm/portable"),
        Path(f"/var/tmp/rosrm-{uid}/portable"),  # noqa: S108 - owner and mode are checked
    )


def make_control_root(uid: int) -> Path:
    """Create the first parent of control directories that can be used, and return it.

    Raises:
        PortableError: none can be used; the message has the reason for each.
    """
    faults = []
    for root in control_roots(uid):
        if root.is_relative_to(_SERVICE) and not is_directory(_SERVICE):
            continue
        try:
            make(root, uid)
        except OSError as error:
            faults.append(f"{root}: {reason_of(error)}")
        except PortableError as error:
            faults.append(str(error))
        else:
            return root
    raise PortableError(f"no control directory can be made for user {uid}: {'; '.join(faults)}")


def is_control_directory(directory: Path, uid: int) -> bool:
    """Return True if a path is one of a control directory of a user."""
    return directory.parent in control_roots(uid) and not directory.name.startswith(".")


def control_directory(token: str, uid: int) -> Path:
    """Return the control directory of one instance.

    Args:
        token: names the instance, unique on all hosts that share this /tmp; a plain file name.
        uid: the user that the process runs as.

    Raises:
        PortableError: the token is no plain file name.
    """
    if not token or "/" in token or token.startswith("."):
        raise PortableError(f"{token!r} cannot name a control directory: a plain file name can")
    return control_root(uid) / token


def directory_of(pid: int) -> Path | None:
    """Return the control directory that a process got at its start; None: it got none.

    Raises:
        OSError: the process has ended, or may not be read by this user.
    """
    mark = f"{VARIABLE}=".encode()
    variables = read_environment(pid)
    named = next((word[len(mark) :] for word in variables if word.startswith(mark)), b"")
    return Path(os.fsdecode(named)) if named else None


def make_directory(directory: Path, uid: int | None = None) -> None:
    """Create an empty control directory, before a process starts or is restored.

    Args:
        directory: an absolute path, readable by its owner alone. For another user it must be one
            of `is_control_directory`, because a process chooses the path that it reports.
        uid: the owner; None: this process's user.

    Raises:
        PortableError: it cannot be created, or belongs to another user.
    """
    owner = os.geteuid() if uid is None else uid
    if owner != os.geteuid() and not is_control_directory(directory, owner):
        raise PortableError(
            f"{directory} is no control directory of user {owner}: these are in "
            f"{control_root(owner)}"
        )
    try:
        make(directory, owner)
    except OSError as error:
        raise PortableError(
            f"the control directory {directory} cannot be made: {reason_of(error)}"
        ) from error
    remove_messages(directory)  # requests follow only after the node has written a status


def ask_prepare(directory: Path, pid: int | None, request_id: str) -> None:
    """Request graph departure from a running node. Repeating the same request has no effect.

    Args:
        directory: its control directory.
        pid: its process, which gets a signal; None: the node polls four times a second.
        request_id: identifies this attempt to move the node; never used before.

    Raises:
        PortableError: the request cannot be delivered; the message says what to do.
    """
    status = read_message(directory, Status)
    if status is None:
        raise PortableError(
            f"no portable node has joined in {directory}: its program does not use "
            f"rosrm_criu.node.run_portable, or has not come so far yet"
        )
    if status.state is State.FAILED:
        raise PortableError(f"the node has failed: {status.fault}")
    _ask(directory, pid, Request(request_id, Want.LEAVE))


def ask_resume(directory: Path, pid: int | None, request_id: str) -> None:
    """Request a rejoin from a node that has left; a node that has not left yet stays.

    The request may precede the restore (`pid` None): then the node rejoins as soon as it runs.

    Args:
        directory: its control directory; on another host the path is the same.
        pid: its process, which gets a signal; None: the node polls every 2 ms while away.
        request_id: the one of the request to leave.

    Raises:
        PortableError: the request cannot be delivered; the message says what to do.
    """
    _ask(directory, pid, Request(request_id, Want.JOIN))


def await_left(directory: Path, request_id: str, timeout: float, pid: int | None = None) -> Status:
    """Wait until a node has left: it holds no ROS entity any more and can be dumped.

    Args:
        directory: its control directory.
        request_id: the one given to `ask_prepare`.
        timeout: seconds.
        pid: its process; the wait ends when that process ends.

    Raises:
        PortableError: the node refused or failed, the request was withdrawn, or the timeout passed.
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
    """Wait until a node runs in the ROS graph again.

    Args:
        directory: its control directory.
        request_id: the one given to `ask_resume`.
        timeout: seconds.
        pid: its process; the wait ends when that process ends.

    Raises:
        PortableError: the node failed, or the timeout passed.
    """
    status = _await(directory, request_id, State.RUNNING, timeout, pid)
    if status.state is State.FAILED:
        raise PortableError(f"the node cannot join the ROS graph again: {status.fault}")
    return status


def _ask(directory: Path, pid: int | None, request: Request) -> None:
    if pid is not None:
        _check_catches(pid)
    try:
        write_message(directory, request)
    except OSError as error:
        raise PortableError(f"{directory} cannot be written: {reason_of(error)}") from error
    if pid is not None and (why := send(pid, SIGNAL)):
        raise PortableError(f"process {pid} cannot be signalled: {why}")


def listens(pid: int) -> bool:
    """Return True if a process handles the request signal; an ended process does not.

    Raises:
        OSError: no look is possible now.
    """
    try:
        _check_catches(pid)
    except PortableError:
        return False
    return True


def _check_catches(pid: int) -> None:
    """Raise `PortableError` unless the process catches or blocks the signal, which would kill it.

    The shim of a restored process blocks all signals and forwards them.
    """
    status = _of_process(pid)
    safe = int(status.get("SigCgt", "0"), 16) | int(status.get("SigBlk", "0"), 16)
    if not safe >> (SIGNAL - 1) & 1:
        raise PortableError(
            f"process {pid} does not catch signal {SIGNAL}, so it is no portable node (or a "
            f"program around one: start the node itself); it was not asked"
        )


def _of_process(pid: int) -> dict[str, str]:
    """Return the lines of /proc/PID/status.

    Raises:
        PortableError: the process has ended.
        OSError: no look is possible now.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        raise PortableError(f"process {pid} has ended") from None
    found = dict(line.split(":\t", 1) for line in lines.splitlines() if ":\t" in line)
    if found.get("State", "")[:1] in "ZX":
        raise PortableError(f"process {pid} has ended")
    return {name: value.strip() for name, value in found.items()}


def _await(
    directory: Path, request_id: str, target: State, timeout: float, pid: int | None
) -> Status:
    """Return the first status that answers a request or is final."""
    deadline = clocks.boot_time() + timeout
    while True:
        status = read_message(directory, Status)
        if status is not None and _is_answer(status, request_id, target):
            return status
        if pid is not None:
            _of_process(pid)
        if clocks.boot_time() >= deadline:
            raise PortableError(_why_not(directory, request_id, target, timeout, pid, status))
        time.sleep(_LOOK)


def _is_answer(status: Status, request_id: str, target: State) -> bool:
    if status.state is State.FAILED:
        return True
    if status.request != request_id:
        return False
    # RUNNING also answers a wait for LEFT: the node refused, or the request was withdrawn.
    return status.state in (target, State.RUNNING)


def _why_not(
    directory: Path, request_id: str, target: State, timeout: float, pid: int | None,
    status: Status | None,
) -> str:  # fmt: skip
    what = "left the ROS graph" if target is State.LEFT else "joined the ROS graph again"
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
    """Describe the likely cause of the delay, as far as /proc shows it."""
    if pid is None:
        return ""
    if _of_process(pid).get("State", "")[:1] in "tT":
        return f"; process {pid} is stopped (SIGSTOP): continue it, or end it"
    return f"; process {pid} runs: a callback may be taking its time"
