"""Cache of artifacts on a host: each digest once, and the directories that processes see.

```
trees/DIGEST-SIZE/content   one unpacked artifact, read-only
sets/KEY/NAME               the artifacts of processes under their names: hard links to the trees
incoming/                   archives that arrive, and their contents before they are complete
```
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from rosrm.artifacts.unpack import CONTENT, is_intact, remove, unpack
from rosrm.errors import Refused, TransferError
from rosrm.model.artifacts import Artifact, set_key
from rosrm.model.placeholders import ARTIFACTS
from rosrm.runtime import durable
from rosrm.runtime.disk_space import room_for
from rosrm.runtime.private_files import make_private_directory, open_private, write_all
from rosrm.shortage import exists, is_directory
from rosrm.wording import reason_of
from rosrm.wording import size as sized

#: Bytes of the disk that stay free.
_RESERVE: Final = 100_000_000

#: Directory in which a process sees its artifacts, as in messages about its program.
_SET: Final = re.compile(r"/\S*/sets/[0-9a-f]{32}(?=/)")

#: The artifacts of the processes that have not ended, one tuple for each.
Used = Iterable[tuple[Artifact, ...]]


def set_directory(root: Path, artifacts: Iterable[Artifact]) -> Path:
    """Return the directory in which a process sees its artifacts."""
    return root / "sets" / set_key(artifacts)


def without_directories(text: str) -> str:
    """Return a text with `{artifacts}` in place of directories of artifacts, as users know them.

    So the messages of all hosts about one artifact are equal.
    """
    return _SET.sub(f"{{{ARTIFACTS}}}", text)


class Incoming:
    """Archive of an artifact that arrives in parts; one thread at a time uses it."""

    def __init__(self, artifact: Artifact, path: Path) -> None:
        self.artifact = artifact
        self.path = path
        self._file = open_private(str(path), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        from hashlib import sha256  # noqa: PLC0415 - OpenSSL, 1 MiB, only where artifacts are used

        self._digest: Any = sha256()

    def write(self, data: bytes) -> None:
        """Append a part; raises `Refused`."""
        try:
            write_all(self._file, data)
        except OSError as error:
            raise _unwritable(self.artifact, self.path, error) from None
        self._digest.update(data)

    def check(self) -> None:
        """Raise `Refused` if the contents do not have the digest of the artifact."""
        if self._digest.hexdigest() != self.artifact.digest:
            raise Refused(
                f"artifact {self.artifact.name!r}: what the master sent does not match its digest; "
                "remove the process with `rosrm prune`, and submit it again",
                "damaged",
            )

    def close(self) -> None:
        """Delete the archive."""
        os.close(self._file)
        self.path.unlink(missing_ok=True)


class ArtifactCache:
    """The artifacts on this host; one thread at a time uses it.

    Args:
        root: directory of the cache.
        max_size: most bytes of all artifacts.
    """

    def __init__(self, root: Path, max_size: int) -> None:
        self._root = root
        self._max_size = max_size
        with suppress(OSError):  # a later use reports the reason
            remove(root / "incoming")
        self._incoming: list[Incoming] = []
        self._number = 0

    def missing(self, artifacts: Sequence[Artifact], used: Used) -> list[Artifact]:
        """Return the artifacts that are not here; delete those that were changed here.

        Those of other processes that run are not checked: a process may have changed its own.
        """
        in_use = {one.digest for others in used for one in others}
        found: dict[str, Artifact] = {}
        for one in artifacts:
            tree = self._tree(one)
            if is_directory(tree) and (one.digest in in_use or is_intact(tree)):
                os.utime(tree)  # the time of its last use
                continue
            if exists(tree):
                self._delete(tree, used)
            found[one.digest] = one
        return list(found.values())

    def begin(self, artifact: Artifact, used: Used) -> Incoming:
        """Make room for an artifact, and return the archive to fill; raises `Refused`."""
        self._make_room(artifact, list(used))
        self._number += 1
        directory = self._root / "incoming"
        path = directory / f"{artifact.digest[:16]}-{self._number}.tar"
        try:
            make_private_directory(self._root)
            make_private_directory(directory)
            free = shutil.disk_usage(directory).free
            # The archive and its contents are on the disk together for a moment.
            if free - 2 * artifact.size < _RESERVE:
                raise Refused(
                    f"artifact {artifact.name!r} needs {sized(2 * artifact.size)} while it is "
                    f"unpacked; {room_for(path)}, and {sized(_RESERVE)} stay free",
                    "full",
                )
            incoming = Incoming(artifact, path)
        except OSError as error:
            raise _unwritable(artifact, path, error) from None
        self._incoming.append(incoming)
        return incoming

    def finish(self, incoming: Incoming) -> None:
        """Check and unpack a complete archive, and delete the archive; raises `Refused`."""
        artifact, target = incoming.artifact, self._tree(incoming.artifact)
        directory = incoming.path.with_suffix("")
        try:
            incoming.check()
            if target.is_dir():
                return  # a cancelled fetch of it had all parts, and completed after this one began
            unpack(incoming.path, directory)
            target.parent.mkdir(mode=0o700, exist_ok=True)
            durable.rename_durably(str(directory), str(target))
        except TransferError as error:
            raise Refused(f"artifact {artifact.name!r}: {error}", "damaged") from None
        except OSError as error:
            raise _unwritable(artifact, directory, error) from None
        finally:
            self.drop(incoming)
            with suppress(OSError):
                remove(directory)

    def drop(self, incoming: Incoming) -> None:
        """Delete an archive that is not needed any more."""
        if incoming in self._incoming:
            self._incoming.remove(incoming)
            incoming.close()

    def assemble(self, artifacts: Sequence[Artifact]) -> Path:
        """Put the artifacts of a process together; return their directory; raises `Refused`."""
        target = set_directory(self._root, artifacts)
        if target.is_dir():
            return target
        new = self._root / "incoming" / target.name
        try:
            make_private_directory(new.parent)
            remove(new)
            new.mkdir(mode=0o700)
            for one in artifacts:
                place = new / one.name
                place.parent.mkdir(parents=True, exist_ok=True)
                _link(self._tree(one) / CONTENT, place)
            target.parent.mkdir(mode=0o700, exist_ok=True)
            new.rename(target)
            above = {place for one in artifacts for place in (target / one.name).parents}
            for directory in above - {target.parent, *target.parent.parents}:
                directory.chmod(0o555)
        except OSError as error:
            raise Refused(f"the artifacts cannot be put together here: {error}", "full") from None
        return target

    # --- room ----------------------------------------------------------------------------

    def _tree(self, artifact: Artifact) -> Path:
        return self._root / "trees" / f"{artifact.digest}-{artifact.size}"

    def _make_room(self, artifact: Artifact, used: list[tuple[Artifact, ...]]) -> None:
        """Delete unused artifacts, the one used longest ago first, until there is room."""
        in_use = {self._tree(one).name for others in used for one in others}
        sizes = {path: _size_of(path) for path in _entries(self._root / "trees")}
        taken = sum(sizes.values()) + sum(one.artifact.size for one in self._incoming)
        unused = [path for path in sizes if path.name not in in_use]
        stays = taken - sum(map(sizes.__getitem__, unused))
        if stays + artifact.size > self._max_size:
            raise Refused(
                f"artifact {artifact.name!r} has {sized(artifact.size)}, and the artifacts of this "
                f"host may have {sized(self._max_size)} in all, of which {sized(stays)} are in "
                "use; raise `artifacts.max_size` in its host.yaml",
                "full",
            )
        for path in sorted(unused, key=lambda path: path.stat().st_mtime):
            if taken + artifact.size <= self._max_size:
                return
            self._delete(path, used)
            taken -= sizes[path]

    def _delete(self, tree: Path, used: Used) -> None:
        """Delete an artifact, and all unused sets, whose hard links would keep its contents."""
        in_use = {set_key(one) for one in used}
        for path in _entries(self._root / "sets"):
            if path.name not in in_use:
                remove(path)
        remove(tree)


def _entries(directory: Path) -> list[Path]:
    return list(directory.iterdir()) if directory.is_dir() else []


def _size_of(tree: Path) -> int:
    size = tree.name.partition("-")[2]
    return int(size) if size.isdigit() else 0


def _link(source: Path, place: Path) -> None:
    """Link a file, or all files of a directory, to another place."""
    if source.is_dir():
        shutil.copytree(source, place, symlinks=True, copy_function=os.link)
    else:
        os.link(source, place)


def _unwritable(artifact: Artifact, path: Path, error: OSError) -> Refused:
    room = room_for(path)
    reason = f"artifact {artifact.name!r} cannot be stored here: {reason_of(error)}"
    return Refused(f"{reason}; {room}" if room else reason, "full")
