"""Store of the master for the contents of artifacts: one archive for each digest, bounded."""

from __future__ import annotations

import os
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import Refused
from rosrm.model.artifacts import LARGEST_ARTIFACT, is_digest
from rosrm.model.ledger import Store, bound_of
from rosrm.runtime import durable
from rosrm.runtime.disk_space import room_for
from rosrm.runtime.private_files import make_private_directory, open_private, write_all
from rosrm.shortage import SHORTAGE
from rosrm.wording import reason_of
from rosrm.wording import size as sized

#: Seconds for which contents stay that no process refers to, because their processes are about to
#: be submitted.
_GRACE: Final = 600.0
#: Seconds after which an upload without a new part has ended.
_IDLE: Final = 60.0
#: Most uploads at a time.
_MOST_UPLOADS: Final = 16
_PART: Final = ".part"


@dataclass(slots=True)
class _Upload:
    """Contents that arrive from one client."""

    path: Path
    file: int
    size: int
    used: float
    offset: int = 0
    digest: Any = field(default_factory=sha256)


class ArtifactStore:
    """The archives of artifacts in one directory.

    One thread calls all methods except `has`, which any thread may call.

    Args:
        root: directory of the archives, each of which has its digest as name.
        max_size: most bytes of all archives.
        clock: monotonic seconds.
    """

    def __init__(
        self, root: Path, max_size: int, clock: Callable[[], float] = clocks.boot_time
    ) -> None:
        self._root = root
        self._max_size = max_size
        self._clock = clock
        self._sizes: dict[str, int] = {}
        #: When each archive was offered last; those of a former run count as old.
        self._offered: dict[str, float] = {}
        self._uploads: dict[tuple[str, str], _Upload] = {}
        self._number = 0
        self._scan()

    def _scan(self) -> None:
        """Find the archives of a former run, and delete what had not arrived completely."""
        if not self._root.exists():
            return
        make_private_directory(self._root)
        for path in self._root.iterdir():
            if path.name.endswith(_PART):
                path.unlink()
            elif is_digest(path.name):
                self._sizes[path.name] = path.stat().st_size

    def has(self, digest: str, size: int) -> bool:
        """Return True if an archive of this size is stored."""
        return self._sizes.get(digest) == size

    def take(
        self, sender: str, digest: str, size: int, offset: int, data: bytes,
        *, keep: AbstractSet[str],
    ) -> int:  # fmt: skip
        """Store a part of an archive, and return the offset of the next one.

        Args:
            sender: principal and run, separated by a space. Each has its own uploads, so that none
                can spoil those of others, and all of one principal are bounded.
            size: of the whole archive, which has arrived when the result is `size`.
            data: b"": only return the offset, and make room for the archive if it is unknown; a
                part of an unknown archive is not stored.
            keep: digests of the archives that stay, because processes refer to them.

        Raises:
            Refused: the archive is no valid one, too large, or there is no room for it.
        """
        if not is_digest(digest) or not 0 < size <= LARGEST_ARTIFACT:
            raise Refused(f"{digest!r:.80} with {size} bytes is no artifact")
        now = self._clock()
        self._end_idle(now)
        if self.has(digest, size):
            self._offered[digest] = now
            return size
        upload = self._uploads.get((sender, digest))
        if upload is None or upload.size != size:
            if data:
                return 0
            upload = self._begin(sender, digest, size, now, keep)
        upload.used = now
        if offset == upload.offset:
            self._write(sender, digest, upload, data)
        return upload.offset

    def read(self, digest: str, offset: int, most: int) -> tuple[int, bytes]:
        """Return the size of an archive, and at most `most` of its bytes.

        Raises:
            Refused: it is not stored, or cannot be read; "busy": only now.
        """
        size = self._sizes.get(digest)
        if size is None:
            raise Refused(
                f"the master does not have the artifact {digest[:12]}; submit the process again",
                "unknown",
            )
        try:
            with (self._root / digest).open("rb", buffering=0) as file:
                file.seek(offset)
                return size, file.read(max(0, min(most, size - offset)))
        except OSError as error:
            if error.errno in SHORTAGE:
                why = f"the master cannot read an artifact now: {reason_of(error)}"
                raise Refused(why, "busy") from None
            self._sizes.pop(digest, None)
            raise Refused(
                f"the master cannot read the artifact {digest[:12]} ({reason_of(error)}); submit "
                "the process again",
                "unknown",
            ) from None

    # --- uploads -------------------------------------------------------------------------

    def _begin(
        self, sender: str, digest: str, size: int, now: float, keep: AbstractSet[str]
    ) -> _Upload:
        self._end((sender, digest))
        principal = sender.partition(" ")[0]
        own = sum(one.partition(" ")[0] == principal for one, _ in self._uploads)
        if own >= bound_of(Store.UPLOADS, is_operator=False).number:
            raise Refused(f"{principal} is sending {own} other artifacts", "busy")
        if len(self._uploads) >= _MOST_UPLOADS:
            raise Refused(f"{_MOST_UPLOADS} other artifacts are being sent", "busy")
        self._make_room(size, now, keep)
        self._number += 1
        path = self._root / f"{digest[:16]}-{self._number}{_PART}"
        try:
            make_private_directory(self._root)
            file = open_private(str(path), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        except OSError as error:
            raise _unwritable(path, error) from None
        upload = self._uploads[sender, digest] = _Upload(path, file, size, now)
        return upload

    def _write(self, sender: str, digest: str, upload: _Upload, data: bytes) -> None:
        if upload.offset + len(data) > upload.size:
            self._end((sender, digest))
            raise _changed(digest)
        try:
            write_all(upload.file, data)
        except OSError as error:
            self._end((sender, digest))
            raise _unwritable(upload.path, error) from None
        upload.digest.update(data)
        upload.offset += len(data)
        if upload.offset == upload.size:
            self._complete(sender, digest, upload)

    def _complete(self, sender: str, digest: str, upload: _Upload) -> None:
        if upload.digest.hexdigest() != digest:
            self._end((sender, digest))
            raise _changed(digest)
        try:
            durable.rename_durably(str(upload.path), str(self._root / digest))
        except OSError as error:
            self._end((sender, digest))
            raise _unwritable(upload.path, error) from None
        del self._uploads[sender, digest]
        os.close(upload.file)
        self._sizes[digest] = upload.size
        self._offered[digest] = self._clock()

    def _end_idle(self, now: float) -> None:
        for key in [key for key, one in self._uploads.items() if now - one.used >= _IDLE]:
            self._end(key)

    def _end(self, key: tuple[str, str]) -> None:
        """Remove what has arrived of an upload, if there is one."""
        upload = self._uploads.pop(key, None)
        if upload is not None:
            with suppress(OSError):  # the first fault of a disk is the one to report
                os.close(upload.file)
            with suppress(OSError):
                upload.path.unlink(missing_ok=True)

    # --- room ----------------------------------------------------------------------------

    def _make_room(self, size: int, now: float, keep: AbstractSet[str]) -> None:
        """Delete unreferenced archives, the one offered longest ago first, until there is room."""
        taken = sum(self._sizes.values()) + sum(one.size for one in self._uploads.values())
        old = [
            digest for digest in self._sizes
            if digest not in keep and now - self._offered.get(digest, -_GRACE) >= _GRACE
        ]  # fmt: skip
        stays = taken - sum(map(self._sizes.__getitem__, old))
        if stays + size > self._max_size:
            raise Refused(
                f"the master has no room for an artifact of {sized(size)}: its store may have "
                f"{sized(self._max_size)}, and {sized(stays)} are in use; remove ended processes "
                "and cancelled applications with `rosrm prune`, or raise `artifacts.max_size` in "
                "cluster.yaml",
                "full",
            )
        old.sort(key=lambda digest: self._offered.get(digest, 0.0))
        for digest in old:
            if taken + size <= self._max_size:
                return
            (self._root / digest).unlink(missing_ok=True)
            taken -= self._sizes.pop(digest)


def _changed(digest: str) -> Refused:
    return Refused(
        f"the contents of the artifact {digest[:12]} changed while they were sent; nothing was "
        "queued: submit again",
        "changed",
    )


def _unwritable(path: Path, error: OSError) -> Refused:
    room = room_for(path)
    reason = f"the master cannot store an artifact: {reason_of(error)}"
    return Refused(f"{reason}; {room}" if room else reason, "full")
