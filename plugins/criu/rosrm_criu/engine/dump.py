"""Dump of an instance's process tree into an image; the processes are stopped during the dump.

CRIU options and their reasons: `--tcp-close`: TCP connections are restored closed, because their
peers do not wait (listening and UDP sockets are restored as they were). `--file-locks`: file locks
are restored. `--manage-cgroups=ignore`: the process is restored in its new instance's cgroup.
"""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.supervisor import paths, procfs
from rosrm.supervisor.procfs import inner_pid
from rosrm.wording import reason_of
from rosrm_criu.engine import criu_log, external_resources, image, open_files, process_tree
from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.image import Manifest

#: Options for both the dump and the restore.
COMMON: Final = ("--tcp-close", "--file-locks", "--manage-cgroups=ignore")

#: Seconds for CRIU to stop all threads; if they pass, nothing has changed.
_FREEZE: Final = 10
#: Seconds for a signal to stop or continue a process.
_SIGNAL: Final = 5.0

#: Function that receives the pages of a dump. Its arguments are a function that runs CRIU with the
#: descriptor of a page server, and the directory of the image.
Receive = Callable[[Callable[[int], None], Path], Mapping[str, int] | None]
#: State of the process after the dump.
Leave = Literal["stopped", "running", "killed"]


def dump(  # noqa: PLR0913 - two of them name the process
    criu: CriuBinary,
    pid: int,
    directory: Path,
    *,
    leave: Leave,
    timeout: float,
    process: str = "",
    instance: int = 0,
    checksums: bool = True,
    receive: Receive | None = None,
) -> Manifest:
    """Dump a process tree, and return the manifest of the image.

    A dump may take long: do not call it in an event loop. After any failure the process runs on.

    Args:
        criu: the CRIU to use.
        pid: the instance's leader. If it is a shim, the restored process below it is dumped.
        directory: of the image; an absolute path, empty or missing.
        leave: state of the process afterwards: "stopped" until `resume` or a SIGKILL, "running" or
            "killed".
        timeout: seconds. Then CRIU is killed, which can harm the process; allow many times the
            expected duration (half a second per GiB, plus the time to write that).
        process: its name, for the manifest.
        instance: its number, for the manifest.
        checksums: add checksums of the files, which reads the image once more. Needed for an image
            that is stored on disk, but not for one that is sent to another host at once.
        receive: receives the pages from CRIU, see `page_server.serve`. The manifest also names the
            files that this function returns. They are not in the image yet, so add no checksums. If
            the function returns None, a second dump begins, unless half of the timeout has passed.

    Raises:
        CriuError: the process cannot be dumped, or the dump failed; the process runs as before.
    """
    root = process_tree.root_of(pid)
    if not process_tree.is_alive(root):
        raise CriuError(f"{process or 'the process'} (pid {pid}) has ended")
    was_stopped = process_tree.is_stopped(root)
    pids = process_tree.tree(root)
    trouble = external_resources.outward(pids)
    if trouble:
        raise CriuError(f"{process or f'pid {pid}'} cannot be dumped: {trouble}")
    image.create(directory)
    try:
        image.check_room(directory, process_tree.memory_of(pids))
        copied = _run(criu, root, directory, timeout, process, receive)
        manifest = _describe(root, directory, Manifest(
            process, instance, platform.node(), clocks.wall_time(), criu.version,
            platform.release(), platform.machine(), inner_pid(root), (), (), "", _shelter(pid), "",
        ))  # fmt: skip
        manifest = replace(manifest, sizes={**manifest.sizes, **copied})
        if leave == "running" and not was_stopped:
            resume(pid)  # only files are read from here on, so the process may run
        if checksums:
            made = image.file_checksums(directory, manifest.sizes)
            manifest = replace(manifest, checksums=made)
        image.write(directory, manifest)
    except BaseException as error:
        outcome = _go_on(root, was_stopped)  # first, because a removal takes a while, or fails
        with contextlib.suppress(OSError):  # the error to report is the first one
            image.remove(directory, logs=False)
        if not isinstance(error, CriuError | OSError):
            raise
        raise CriuError(_explained(directory, error) + outcome) from None
    if leave == "killed":
        kill(pid)
    return manifest


def resume(pid: int) -> None:
    """Continue a process that a dump has left stopped.

    Args:
        pid: the instance's leader.
    """
    process_tree.send(process_tree.tree(process_tree.root_of(pid)), signal.SIGCONT)


def kill(pid: int) -> None:
    """Kill a dumped process at once; its parent must reap it before a restore on this host.

    Args:
        pid: the instance's leader; a shim ends when its restored process ends.
    """
    process_tree.send(reversed(process_tree.tree(process_tree.root_of(pid))), signal.SIGKILL)


def _run(
    criu: CriuBinary, root: int, directory: Path, timeout: float, process: str,
    receive: Receive | None,
) -> Mapping[str, int]:  # fmt: skip
    """Run CRIU; return the size of each file that the image lacks, by path below it."""
    images = directory / image.PAGES
    arguments = (
        "dump", "--tree", str(inner_pid(root)), "--images-dir", str(images),
        "--leave-stopped", *COMMON, "--timeout", str(_FREEZE),
        "--ghost-limit", str(open_files.MOST),
    )  # fmt: skip
    inside = replace(criu, command=(*process_tree.entering(root), *criu.command))

    end = clocks.boot_time() + timeout

    def run(*more: str, pass_fds: Sequence[int] = ()) -> None:
        left = end - clocks.boot_time()
        if left < timeout / 2:  # CRIU would be killed before its end, which can harm the process
            raise CriuError(
                f"the pages of {process or f'pid {root}'} could not be received, and less than "
                f"half of the time-out of {timeout:g} s is left for another dump"
            )
        log = directory / image.DUMP_LOG
        inside.run((*arguments, *more), timeout=left, log=log, pass_fds=pass_fds)

    def send_pages(to: int) -> None:
        run("--page-server", "--ps-socket", str(to), pass_fds=[to])

    try:
        copied = receive(send_pages, directory) if receive else None
        if copied is None:
            shutil.rmtree(images)  # has files if the pages could not all be received
            images.mkdir(mode=0o700)
            run()
    except CriuError as error:
        meaning = _meaning(root, str(error))
        if not meaning:
            raise
        raise CriuError(f"{process or f'pid {root}'} cannot be dumped: {meaning}") from None
    if not process_tree.wait_until_stopped(process_tree.tree(root), _SIGNAL):
        raise CriuError(f"{process or f'pid {root}'} did not stop for its dump")
    return copied or {}


def _meaning(root: int, message: str) -> str:
    """Return CRIU's reason in plain words; the process still exists, so check its descriptors."""
    for one, kind in external_resources.odd_descriptors(process_tree.tree(root)):
        return f"its file descriptor {one.number} is {kind}, which cannot be dumped"
    return criu_log.explain_dump(message)


def _describe(root: int, directory: Path, manifest: Manifest) -> Manifest:
    """Complete the manifest, while the processes are stopped."""
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
    """Return the supervisor's default working directory; "": there is no supervisor."""
    _, state = procfs.read_marks(leader)
    return paths.work_directory(state) if state else ""


def _link(pid: int, name: str) -> str:
    return os.readlink(f"/proc/{pid}/{name}")  # noqa: PTH115 - as /proc says it


def _explained(directory: Path, error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in (errno.ENOENT, errno.ESRCH):
        return f"the process could not be examined: {reason_of(error)}"
    if isinstance(error, OSError):
        return f"the image in {directory} cannot be written: {reason_of(error)}"
    return str(error)


def _go_on(root: int, was_stopped: bool) -> str:
    """Continue the process after a failed dump; return a remark if it does not run as before."""
    pids = process_tree.tree(root)
    if not was_stopped:
        process_tree.send([pid for pid in pids if process_tree.is_stopped(pid)], signal.SIGCONT)
    if not process_tree.is_alive(root):
        return f". The process (pid {root}) ended during the dump"
    end = clocks.boot_time() + _SIGNAL
    while not was_stopped and any(map(process_tree.is_stopped, pids)):
        if clocks.boot_time() > end:
            return f". The process (pid {root}) is still stopped"
        time.sleep(0.001)
    return ""
