"""Restore of an image on this host: a check of its requirements, then CRIU.

This module runs only in the shim (`rosrm_criu.engine.shim`).
"""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import stat
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.supervisor import paths
from rosrm.supervisor.procfs import SUPERVISOR_MARK
from rosrm_criu.engine import criu_log, image, relocation
from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.dump import COMMON
from rosrm_criu.engine.image import HeldFile, Manifest, MappedFile

#: File into which CRIU writes the pid of the restored root.
_PID_FILE: Final = "restored.pid"
#: LTTng's files, which every ROS process maps: without content, and made by its first user.
_TRACING: Final = "/dev/shm/lttng-ust-wait-"  # noqa: S108 - LTTng's own
#: Ids that CRIU and its children may use during a restore.
_IDS_OF_CRIU: Final = 400


def moved_here(manifest: Manifest) -> Manifest:
    """Return the manifest with this host's paths: default working directories differ by host."""
    state = os.environ.get(SUPERVISOR_MARK, "")
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
    if not Path(manifest.working_directory).is_dir():
        raise CriuError(
            f"the working directory {manifest.working_directory} of the process is missing on "
            f"{here}: make it, or give the process a `working_directory` that every host has"
        )
    if not Path(manifest.interpreter).is_file():
        raise CriuError(f"the program {manifest.interpreter} of the process is missing on {here}")
    for held in manifest.files:
        if not held.copy and not held.grows:
            _check_file(held, here, "has open")
    for mapped in manifest.mapped:
        if not mapped.path.startswith(_TRACING):
            _check_file(mapped, here, "has mapped")


def _check_file(file: HeldFile | MappedFile, here: str, holds: str) -> None:
    try:
        status = os.stat(file.path)  # noqa: PTH116 - hundreds of them
    except OSError as error:
        raise CriuError(
            f"the file {file.path}, which the process {holds}, cannot be found on {here}: "
            f"{error.strerror}"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        raise CriuError(f"{file.path}, which the process {holds}, is no file on {here}")
    if status.st_size != file.size:
        raise CriuError(
            f"the file {file.path}, which the process {holds}, is another one on {here}: "
            f"{status.st_size} bytes instead of {file.size}"
        )


def prepare(directory: Path, manifest: Manifest) -> None:
    """Put back the files that follow the process; create missing append-only and LTTng files.

    The checksums of the whole image are compared before the first change. Otherwise a damaged file
    could replace an intact one, and CRIU would restore damaged memory without an error.

    Raises:
        CriuError: the image is damaged, or a file cannot be put back.
    """
    image.check_contents(directory, manifest)
    for mapped in manifest.mapped:
        if mapped.path.startswith(_TRACING) and not Path(mapped.path).exists():
            _make_tracing_file(mapped)
    for held in manifest.files:
        try:
            _put_back(directory, held)
        except OSError as error:
            raise CriuError(
                f"the file {held.path}, which the process has open, cannot be put back on "
                f"{platform.node()}: {error.strerror}"
            ) from None


def _put_back(directory: Path, held: HeldFile) -> None:
    target = Path(held.path)
    if not held.copy and (not held.grows or target.exists()):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    if held.copy:
        _replace(directory / held.copy, target, held.mode)
    else:
        target.touch(mode=held.mode)


def _replace(source: Path, target: Path, mode: int) -> None:
    """Replace a file by a copy with the same owner; no symbolic link there is followed.

    Otherwise the owner of the folder could make root write anywhere.
    """
    new = target.with_name(f".{target.name}.rosrm")
    new.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        with source.open("rb") as copy, os.fdopen(os.open(new, flags, 0o600), "wb") as file:
            shutil.copyfileobj(copy, file)
            if os.geteuid() == 0:
                before = (target if target.exists() else target.parent).lstat()
                os.fchown(file.fileno(), before.st_uid, before.st_gid)
            os.fchmod(file.fileno(), mode)
        new.replace(target)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def _make_tracing_file(mapped: MappedFile) -> None:
    new = f"{mapped.path}.{os.getpid()}"
    descriptor = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        os.ftruncate(descriptor, mapped.size)
        os.fchmod(descriptor, mapped.mode)
        os.link(new, mapped.path)  # unlike rename, this keeps a file that appeared since the check
    except FileExistsError:
        pass
    finally:
        os.close(descriptor)
        os.unlink(new)  # noqa: PTH108


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
    """
    with contextlib.suppress(OSError, ValueError):
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        start, end = int(fields[47]), int(fields[48])
        descriptor = os.open(f"/proc/{pid}/mem", os.O_RDWR | os.O_CLOEXEC)
        try:
            block = os.pread(descriptor, end - start, start)
            for name, value in marks.items():
                _overwrite(descriptor, start, block, name.encode(), os.fsencode(value))
        finally:
            os.close(descriptor)


def _overwrite(memory: int, start: int, block: bytes, name: bytes, value: bytes) -> None:
    found = (b"\0" + block).find(b"\0" + name + b"=")
    if found < 0:
        return
    begin = found + len(name) + 1
    end = block.index(b"\0", begin)
    new = value if len(value) <= end - begin else b""
    os.pwrite(memory, new.ljust(end - begin, b"\0"), start + begin)
