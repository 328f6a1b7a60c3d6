"""Has a portable node leave the ROS graph, and come back where it stands still."""

from __future__ import annotations

import os
from pathlib import Path

from rosrm.errors import CriuError
from rosrm_criu.control import (
    State,
    ask_prepare,
    ask_resume,
    await_left,
    control_directory,
    directory_of,
    listens,
    make_directory,
    status_of,
)
from rosrm_criu.engine import dump, process_tree
from rosrm_criu.executors.request import check_wanted


def leave(pid: int, control: Path, attempt: str, timeout: float) -> float:
    """Have it leave, so that it can be dumped; returns the seconds that it says it took.

    Args:
        pid: of the instance's leader.
        control: directory in which the node is spoken to.
        attempt: by which it is asked.
        timeout: seconds.

    Raises:
        CriuError, PortableError: it does not leave.
    """
    root = process_tree.root_of(pid)
    if process_tree.is_stopped(root):  # an earlier asking of this very step has dumped it
        dump.resume(pid)
    check_wanted(attempt)
    ask_prepare(control, root, attempt)
    return await_left(control, attempt, timeout, root).seconds.get("leave", 0.0)


def call_back(pid: int, control: Path, attempt: str) -> bool:
    """Let it go on where it stands still, and ask it to join; that is not waited for.

    False: it listens to nobody, so it is no portable node, and never was asked to leave.

    Raises:
        PortableError: it cannot be asked now, as where the disk is full.
    """
    dump.resume(pid)
    root = process_tree.root_of(pid)
    if not listens(root):
        return False
    if not control.exists():  # a copy of it that has ended took it along, where hosts share /tmp
        make_directory(control, owner_of(pid))
    ask_resume(control, root, attempt)
    return True


def has_failed(control: Path) -> bool:
    """Whether the node says that it can never join again."""
    found = status_of(control)
    return found is not None and found.state is State.FAILED


def control_of(pid: int) -> Path:
    """Where the node is spoken to: it was told at its start, and keeps it through a move."""
    try:
        found = directory_of(process_tree.root_of(pid))
    except OSError as error:
        raise CriuError(f"process {pid} cannot be looked at: {error.strerror}") from None
    if found is None:
        raise CriuError(
            f"process {pid} was not started to be moved by criu: restart it, with "
            f"`migration: criu` in its file"
        )
    owner = owner_of(pid)
    # The environment is the process's own: who writes there for another user chooses the place.
    if owner != os.geteuid() and found != control_directory(found.name, owner):
        raise CriuError(f"process {pid} of user {owner} names {found}: that is no place for it")
    return found


def owner_of(pid: int) -> int:
    """The user whom the process belongs to; raises `CriuError` where it has ended."""
    try:
        return Path(f"/proc/{process_tree.root_of(pid)}").stat().st_uid
    except OSError:
        raise CriuError(f"process {pid} has ended") from None
