"""Graph departure of a portable node for a dump, and its rejoin on the same host."""

from __future__ import annotations

import os
from pathlib import Path

from rosrm.errors import CriuError
from rosrm.shortage import exists, raise_shortage, status
from rosrm.wording import reason_of
from rosrm_criu.control.client import (
    ask_prepare,
    ask_resume,
    await_left,
    directory_of,
    is_control_directory,
    listens,
    make_directory,
)
from rosrm_criu.control.messages import State, Status, read_message
from rosrm_criu.engine import dump, process_tree
from rosrm_criu.executors import attempts


def leave(pid: int, control: Path, attempt: str, timeout: float) -> float:
    """Make the node leave, so that it can be dumped; return its own measured duration in seconds.

    Args:
        pid: the instance's leader.
        control: the node's control directory.
        attempt: id of the request to leave.
        timeout: seconds.

    Raises:
        CriuError, PortableError: the node does not leave.
    """
    root = process_tree.root_of(pid)
    if process_tree.is_stopped(root):  # an earlier call of the same step has dumped it
        dump.resume(pid)
    attempts.check_wanted(attempt)
    ask_prepare(control, root, attempt)
    return await_left(control, attempt, timeout, root).seconds.get("leave", 0.0)


def call_back(pid: int, control: Path, attempt: str) -> bool:
    """Continue the node on its host, and request a rejoin without waiting for it.

    Args:
        pid: the instance's leader.
        control: the node's control directory.
        attempt: id of the request to leave.

    Returns:
        False if the process does not handle requests. Then it is no portable node, and was never
        asked to leave.

    Raises:
        PortableError: the request cannot be written, e.g. because the disk is full.
        OSError: the process cannot be examined now.
    """
    dump.resume(pid)
    root = process_tree.root_of(pid)
    if not listens(root):
        return False
    if not exists(control):  # where hosts share /tmp, a copy of the node that ended has removed it
        make_directory(control, owner_of(pid))
    ask_resume(control, root, attempt)
    return True


def has_failed(control: Path) -> bool:
    """Return True if the node reports that it can never rejoin."""
    found = read_message(control, Status)
    return found is not None and found.state is State.FAILED


def control_of(pid: int) -> Path:
    """Return the control directory of the node, fixed at its start and unchanged by migrations.

    Raises:
        CriuError: the process was not started to be moved, or has ended.
        OSError: no look is possible now.
    """
    try:
        found = directory_of(process_tree.root_of(pid))
    except OSError as error:
        raise_shortage(error)
        raise CriuError(f"process {pid} cannot be examined: {reason_of(error)}") from None
    if found is None:
        raise CriuError(
            f"process {pid} was not started to be moved by criu: restart it, with "
            f"`migration: criu` in its file"
        )
    owner = owner_of(pid)
    # A process chooses its environment: another user could name a place for root to write to.
    if owner != os.geteuid() and not is_control_directory(found, owner):
        raise CriuError(f"process {pid} of user {owner} names {found}: that is no place for it")
    return found


def owner_of(pid: int) -> int:
    """Return the uid of the process; raise `CriuError` if it has ended."""
    found = status(f"/proc/{process_tree.root_of(pid)}")
    if found is None:
        raise CriuError(f"process {pid} has ended")
    return found.st_uid
