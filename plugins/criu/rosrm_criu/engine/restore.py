"""Restore of an image on this host: a check of its requirements, then CRIU.

This module runs only in the shim (`rosrm_criu.engine.shim`).
"""

from __future__ import annotations

import os
import platform
import stat
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.shortage import is_directory, is_file, raise_shortage
from rosrm.supervisor import paths
from rosrm.supervisor.procfs import SUPERVISOR_MARK
from rosrm.wording import reason_of
from rosrm_criu.engine import criu_log, image, relocation
from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.dump import COMMON
from rosrm_criu.engine.image import HeldFile, Manifest, MappedFile
from rosrm_criu.engine.put_back import is_tracing

#: File into which CRIU writes the pid of the restored root.
_PID_FILE: Final = "restored.pid"
#: Ids that CRIU and its children may use during a restore.
_IDS_OF_CRIU: Final = 400


def moved_here(manifest: Manifest, state: str | None = None) -> Manifest:
    """Return the manifest with this host's paths: default working directories differ by host.

    Args:
        manifest: of the image.
        state: the supervisor's directory; None: as the environment names it; "": unknown.
    """
    state = os.environ.get(SUPERVISOR_MARK, "") if state is None else state
    new = paths.work_directory(state) if state else ""

    def here(path: str) -> str:
        return relocation.moved(path, manifest.shelter, new)

    return replace(
        manifest,
        shelter=new,
        working_directory=here(manifest.working_directory),
        files=tuple(replace(held, path=here(held.path)) for held in manifest.files),
        mapped=tuple(replace(mapped, path=here(mapped.path)) for mapped in manifest.mapped),
    )


def check(manifest: Manifest) -> None:
    """Raise CriuError, before any change, if this host lacks a requirement of the process."""
    here = platform.node()
    if manifest.machine != platform.machine():
        raise CriuError(f"the image was made on {manifest.machine}; {here} is {platform.machine()}")
    if not is_directory(manifest.working_directory):
        raise CriuError(
            f"the working directory {manifest.working_directory} of the process is missing on "
            f"{here}: make it, or give the process a `working_directory` that every host has"
        )
    if not is_file(manifest.interpreter):
        raise CriuError(f"the program {manifest.interpreter} of the process is missing on {here}")
    for held in manifest.files:
        if not held.copy and not held.grows:
            _check_file(held, here, "has open")
    for mapped in manifest.mapped:
        if not is_tracing(mapped.path):
            _check_file(mapped, here, "has mapped")


def _check_file(file: HeldFile | MappedFile, here: str, holds: str) -> None:
    try:
        status = os.stat(file.path)  # noqa: PTH116 - hundreds of them
    except OSError as error:
        raise CriuError(
            f"the file {file.path}, which the process {holds}, cannot be found on {here}: "
            f"{reason_of(error)}"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        raise CriuError(f"{file.path}, which the process {holds}, is no file on {here}")
    if status.st_size != file.size:
        raise CriuError(
            f"the file {file.path}, which the process {holds}, is another one on {here}: "
            f"{status.st_size} bytes instead of {file.size}"
        )


def restore(
    criu: CriuBinary, directory: Path, manifest: Manifest, shelter: str, *, log: int, timeout: float
) -> int:
    """Restore the process as a descendant of the caller, and return its pid.

    CRIU's processes end, so the nearest subreaper or init above the caller becomes the parent.

    Args:
        criu: the CRIU to use.
        directory: of the image, after `check` and `prepare`.
        manifest: of the image, as `read` returns it.
        shelter: replaces the image's default working directory.
        log: descriptor that becomes standard output and error of the process.
        timeout: seconds; then CRIU is killed.

    Raises:
        CriuError: the restore failed; the message says why.
    """
    pid_file = directory / _PID_FILE
    pid_file.unlink(missing_ok=True)
    logs = [relocation.moved(path, manifest.shelter, shelter) for path in manifest.logs]
    joined = [word for path in logs for word in ("--inherit-fd", f"fd[{log}]:{path.lstrip('/')}")]
    log_file = directory / image.RESTORE_LOG
    with relocation.images(directory / image.PAGES, manifest.shelter, shelter) as images:
        arguments = (
            "restore", "--images-dir", str(images), "--restore-detached",
            "--pidfile", str(pid_file), *COMMON, *joined,
        )  # fmt: skip
        try:
            criu.run(arguments, timeout=timeout, log=log_file, pass_fds=(log,))
        except CriuError as error:
            name = manifest.process or "the process"
            meaning = criu_log.explain_restore(str(error))
            if not meaning:
                raise
            raise CriuError(
                f"{name} cannot be restored on {platform.node()}: {meaning} (log: {log_file})"
            ) from None
    pid = int(pid_file.read_text())
    pid_file.unlink()
    return pid


def id_for_criu(ids: tuple[int, ...], most: int) -> int:
    """Return an id for a new pid namespace after which CRIU's processes take none of the image's.

    Args:
        ids: ids in the image.
        most: size of the id range.
    """
    taken = sorted(one for one in ids if one < most)
    for low, high in zip([300, *taken], [*taken, most], strict=True):
        if high - low > _IDS_OF_CRIU:
            return low
    return 300


def replace_marks(pid: int, marks: Mapping[str, str]) -> None:
    """Change environment variables of a process, as /proc shows them to others.

    Values that the process has already read stay as they were. A new value that is longer than the
    old one is replaced by "".

    Args:
        pid: the process.
        marks: new values by name; "" empties a variable.

    Raises:
        OSError: the system has no room for a look, so the process still has its former marks.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        start, end = int(fields[47]), int(fields[48])
        descriptor = os.open(f"/proc/{pid}/mem", os.O_RDWR | os.O_CLOEXEC)
        try:
            block = os.pread(descriptor, end - start, start)
            for name, value in marks.items():
                _overwrite(descriptor, start, block, name.encode(), os.fsencode(value))
        finally:
            os.close(descriptor)
    except (OSError, ValueError) as error:  # it has ended, or its environment is of its own form
        if isinstance(error, OSError):
            raise_shortage(error)


def _overwrite(memory: int, start: int, block: bytes, name: bytes, value: bytes) -> None:
    found = (b"\0" + block).find(b"\0" + name + b"=")
    if found < 0:
        return
    begin = found + len(name) + 1
    end = block.index(b"\0", begin)
    new = value if len(value) <= end - begin else b""
    os.pwrite(memory, new.ljust(end - begin, b"\0"), start + begin)
