"""Dumps the process tree of an instance into an image; it stands still meanwhile.

Options of CRIU, and why: `--tcp-close`: TCP connections come back closed, for their other ends do
not wait (listening and UDP sockets come back as they were); `--file-locks`: what is locked is
locked again; `--manage-cgroups=ignore`: it comes back in the cgroup of its new instance.
"""

from __future__ import annotations

import errno
import os
import platform
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from rosrm.errors import CriuError
from rosrm.supervisor import paths, procfs
from rosrm.supervisor.procfs import inner_pid
from rosrm_criu.engine import external_resources, image, log_messages, open_files, process_tree
from rosrm_criu.engine.binary import Criu
from rosrm_criu.engine.image import Manifest

#: What both CRIU's dump and its restore are told.
COMMON: Final = ("--tcp-close", "--file-locks", "--manage-cgroups=ignore")

#: Seconds for CRIU to stop all threads; nothing was changed when they have passed.
_FREEZE: Final = 10
#: Seconds that a signal may take to stop a process or let it go on.
_SIGNAL: Final = 5.0

#: What becomes of the process after the dump.
Leave = Literal["stopped", "running", "killed"]


def dump(
    criu: Criu,
    pid: int,
    directory: Path,
    *,
    leave: Leave,
    timeout: float,
    process: str = "",
    instance: int = 0,
    checksums: bool = True,
) -> Manifest:
    """Dump the tree of a process, and say what is in the image.

    It may take its time: no loop should wait for it. Whatever fails, the process runs on.

    Args:
        criu: to use.
        pid: of the instance's leader, which may be a hold: then what it holds is dumped.
        directory: of the image; an absolute path, empty or not there.
        leave: what becomes of the process: "stopped" until `resume` or a SIGKILL, "running" or
            "killed".
        timeout: seconds. CRIU is killed when they have passed, which can harm the process; give it
            many times what it needs (half a second for each GiB, and the time to write that).
        process: its name, for the manifest.
        instance: its number, likewise.
        checksums: make those of the files, which reads the image once more: for an image that is
            to lie on a disk. What goes to another host at once needs none.

    Raises:
        CriuError: what cannot be dumped, or what failed; the process runs as before.
    """
    root = process_tree.root_of(pid)
    if not process_tree.is_alive(root):
        raise CriuError(f"{process or 'the process'} (pid {pid}) has ended")
    was_stopped = process_tree.is_stopped(root)
    pids = process_tree.tree(root)
    tie = external_resources.outward(pids)
    if tie:
        raise CriuError(f"{process or f'pid {pid}'} cannot be dumped: {tie}")
    image.create(directory)
    try:
        image.check_room(directory, process_tree.memory_of(pids))
        _run(criu, root, directory, timeout, process)
        manifest = _describe(root, directory, Manifest(
            process, instance, platform.node(), time.time(), criu.version, platform.release(),
            platform.machine(), inner_pid(root), (), (), "", _shelter(pid), "",
        ))  # fmt: skip
        if leave == "running" and not was_stopped:
            resume(pid)  # the checksums are of files alone: it need not stand still for them
        if checksums:
            made = image.file_checksums(directory, manifest.sizes)
            manifest = replace(manifest, checksums=made)
        image.write(directory, manifest)
    except BaseException as error:
        image.remove(directory, logs=False)
        outcome = _go_on(root, was_stopped)
        if not isinstance(error, CriuError | OSError):
            raise
        raise CriuError(_told(directory, error) + outcome) from None
    if leave == "killed":
        kill(pid)
    return manifest


def resume(pid: int) -> None:
    """Let go on what a dump has left stopped.

    Args:
        pid: of the instance's leader.
    """
    process_tree.send(process_tree.tree(process_tree.root_of(pid)), signal.SIGCONT)


def kill(pid: int) -> None:
    """End what was dumped, at once; its parent has to reap it before it is restored here.

    Args:
        pid: of the instance's leader; a hold ends by itself then.
    """
    process_tree.send(reversed(process_tree.tree(process_tree.root_of(pid))), signal.SIGKILL)


def _run(criu: Criu, root: int, directory: Path, timeout: float, process: str) -> None:
    arguments = (
        "dump", "--tree", str(inner_pid(root)), "--images-dir", str(directory / image.PAGES),
        "--leave-stopped", *COMMON, "--timeout", str(_FREEZE),
        "--ghost-limit", str(open_files.MOST),
    )  # fmt: skip
    inside = replace(criu, command=(*process_tree.entering(root), *criu.command))
    log = directory / image.DUMP_LOG
    try:
        inside.run(arguments, timeout=timeout, log=log)
    except CriuError as error:
        meaning = _meaning(root, str(error))
        if not meaning:
            raise
        raise CriuError(f"{process or f'pid {root}'} cannot be dumped: {meaning}") from None
    if not process_tree.wait_until_stopped(process_tree.tree(root), _SIGNAL):
        raise CriuError(f"{process or f'pid {root}'} did not stop for its dump")


def _meaning(root: int, message: str) -> str:
    """What kept CRIU from it; the process is still there, so its descriptors tell what they are."""
    for one, kind in external_resources.odd_descriptors(process_tree.tree(root)):
        return f"its file descriptor {one.number} is {kind}, which cannot be dumped"
    return log_messages.of_dump(message)


def _describe(root: int, directory: Path, manifest: Manifest) -> Manifest:
    """Complete the manifest; the processes stand still."""
    pids = process_tree.tree(root)
    logs = open_files.logs(root)
    working_directory = _link(root, "cwd")
    return replace(
        manifest,
        ids=tuple(sorted(number for pid in pids for number in process_tree.inner_ids(pid))),
        logs=logs,
        working_directory=working_directory,
        interpreter=_link(root, "exe"),
        files=open_files.open_files(pids, logs, working_directory, directory),
        mapped=open_files.mapped_files(pids),
        sizes=image.file_sizes(directory),
    )


def _shelter(leader: int) -> str:
    """The directory of its supervisor for those that name none; "" where it has no supervisor."""
    _, state = procfs.read_marks(leader)
    return paths.work_directory(state) if state else ""


def _link(pid: int, name: str) -> str:
    return os.readlink(f"/proc/{pid}/{name}")  # noqa: PTH115 - as /proc says it


def _told(directory: Path, error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in (errno.ENOENT, errno.ESRCH):
        return f"it could not be looked at: {error.strerror}"
    if isinstance(error, OSError):
        return f"the image in {directory} cannot be written: {error.strerror}"
    return str(error)


def _go_on(root: int, was_stopped: bool) -> str:
    """After a failure the process is to run as before; what is to be said where it does not."""
    pids = process_tree.tree(root)
    if not was_stopped:
        process_tree.send([pid for pid in pids if process_tree.is_stopped(pid)], signal.SIGCONT)
    if not process_tree.is_alive(root):
        return f". The process (pid {root}) has ended meanwhile"
    end = time.monotonic() + _SIGNAL
    while not was_stopped and any(map(process_tree.is_stopped, pids)):
        if time.monotonic() > end:
            return f". The process (pid {root}) is still stopped"
        time.sleep(0.001)
    return ""
