"""Checks of an image that came from another host, before a process is restored from it.

The source checks the same when it makes an image. A source that was broken into does not: its image
could write any file, or run programs as another user, where the slave or its CRIU may do that.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.shortage import tree
from rosrm_criu.engine import image, protobuf, restore
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.put_back import is_tracing, parts_below

#: CRIU's file of a thread, and the fields that lead to its credentials: core_entry.thread_core,
#: thread_core_entry.creds.
_CORE: Final = re.compile(rf"{image.PAGES}/core-\d+\.img")
_TO_CREDENTIALS: Final = (5, 10)
#: Fields of creds_entry: the ids of the user and of the groups, and the permitted and effective
#: capabilities.
_USERS: Final = frozenset({1, 3, 5, 7})
_GROUPS: Final = frozenset({2, 4, 6, 8, 14})
_CAPABILITIES: Final = frozenset({10, 11})
#: CRIU's files that would give a process other credentials than those of its threads' files.
_OTHER_CREDENTIALS: Final = re.compile(rf"{image.PAGES}/(creds|userns)-\d+\.img")
#: Folders of an image.
_FOLDERS: Final = (image.PAGES, image.PARENT, image.GRANDPARENT, image.COPIES)
#: Bits of an id, or of one number of a set of capabilities; CRIU ignores higher ones.
_WORD: Final = 0xFFFFFFFF


def check_source(uid: int) -> None:
    """Raise CriuError if a process of a user of another host may not be restored by this one."""
    if os.geteuid() not in (0, uid):
        raise CriuError(
            f"the process belongs to the user {uid}, and this host's slave runs as {os.geteuid()}"
        )


def check(directory: Path, *, state: Path, working_directory: str | None, uid: int) -> None:
    """Check a received image.

    Args:
        directory: of the image.
        state: directory of the slave.
        working_directory: of the process, as its file has it; None: the supervisor's.
        uid: of the process, as the source reports it.

    Raises:
        CriuError: the image holds other files than an image has; it would write outside of the
            process's working directory; or the process would get other rights than it had.
    """
    manifest = image.read(directory)
    _check_names(directory, manifest)
    here = restore.moved_here(manifest, str(state))
    _check_working_directory(here, working_directory)
    for held in here.files:
        if held.copy:
            parts_below(held.path, here.working_directory)
        elif held.grows:
            parts_below(held.path, "/")
    for mapped in here.mapped:
        if mapped.path.startswith("/dev/shm/lttng") and not is_tracing(mapped.path):  # noqa: S108
            raise CriuError(f"the file {mapped.path!r} of the image is none of LTTng: refused")
    _check_credentials(directory, manifest, uid)


def _check_names(directory: Path, manifest: Manifest) -> None:
    expected = {*manifest.sizes, image.MANIFEST, image.DUMP_LOG}
    for path in tree(directory):
        name = os.path.relpath(path, directory)
        if name not in expected and name not in _FOLDERS:
            raise CriuError(f"the image holds {name!r}, which its manifest does not name: refused")


def _check_working_directory(here: Manifest, named: str | None) -> None:
    wanted = here.shelter if named is None else str(Path(named).expanduser())
    for allowed in dict.fromkeys((wanted, os.path.realpath(wanted))):
        if here.working_directory == allowed:
            return
        if allowed != "/" and here.working_directory.startswith(f"{allowed}/"):
            parts_below(here.working_directory, allowed)
            return
    if any(held.copy for held in here.files):
        raise CriuError(
            f"the process works in {here.working_directory}, which is not below {wanted}: its "
            "open files cannot follow it. Set `working_directory` in its file"
        )


def _check_credentials(directory: Path, manifest: Manifest, uid: int) -> None:
    cores = [name for name in manifest.sizes if _CORE.fullmatch(name)]
    if not cores or any(map(_OTHER_CREDENTIALS.fullmatch, manifest.sizes)):
        raise CriuError("the image does not show the user of its processes: refused")
    for name in cores:
        try:
            found = list(_credentials((directory / name).read_bytes()))
        except ValueError as error:
            raise CriuError(f"the image is damaged: {name}: {error}") from None
        if not found:
            raise CriuError(f"the image does not show the user of its processes ({name}): refused")
        for one in found:
            _check_rights(one, uid)


def _credentials(data: bytes) -> Iterator[bytes]:
    """Yield the credentials in CRIU's file of a thread; raise ValueError if it is damaged."""
    found: Iterable[bytes] = protobuf.messages(data)
    for number in _TO_CREDENTIALS:
        found = [
            one.value for message in found for one in protobuf.fields(message)
            if one.number == number and isinstance(one.value, bytes)
        ]  # fmt: skip
    yield from found


def _check_rights(credentials: bytes, uid: int) -> None:
    """Raise CriuError if a process would get rights that this slave has not, or ValueError."""
    values: dict[int, list[int]] = {}
    for one in protobuf.fields(credentials):
        if one.number in _USERS | _GROUPS | _CAPABILITIES:
            words = (number & _WORD for number in protobuf.numbers(one.value))
            values.setdefault(one.number, []).extend(words)
    own = os.geteuid()
    users = {one for number in _USERS for one in values.get(number, ())}
    if not users <= {own, uid}:
        raise CriuError(
            f"the image would run as the user {min(users - {own, uid})}, and the process belongs "
            f"to the user {uid}: refused"
        )
    if own == 0:
        return
    groups = {one for number in _GROUPS for one in values.get(number, ())}
    if not groups <= (allowed := {os.getegid(), *os.getgroups()}):
        raise CriuError(
            f"the image would run with the group {min(groups - allowed)}, which this host's slave "
            "does not have: refused"
        )
    for number in _CAPABILITIES:
        wanted = sum(word << 32 * place for place, word in enumerate(values.get(number, ())))
        if wanted & ~_own_capabilities():
            raise CriuError(
                "the image would run with capabilities that this host's slave does not have: "
                "refused"
            )


def _own_capabilities() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return next(int(line[7:], 16) for line in status.splitlines() if line.startswith("CapPrm:"))
