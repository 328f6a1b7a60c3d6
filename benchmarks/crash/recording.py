"""Recording of all writes of a cluster below one directory, by a library that is loaded into it."""

from __future__ import annotations

import os
import stat
import struct
import subprocess
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_SOURCE: Final = Path(__file__).with_name("recorder.c")
#: Kind, flags, lengths of the two texts, inode and offset; as in `recorder.c`.
_HEADER: Final = struct.Struct("<cBHIQQ")
#: Kind of a line of the scenario itself: what it has been told, and so was promised.
MARK: Final = "K"


@dataclass(frozen=True, slots=True)
class Call:
    """A call that changed the directory.

    Attributes:
        kind: O open with O_CREAT or O_TRUNC, W write, T size, R rename, L link, S symlink,
            U unlink or rmdir, M mkdir, F fsync, K mark.
        flags: of O: 1 if it truncates; of R: those of renameat2.
        inode: of the file or directory; 0 where the kind has paths.
        offset: of W; the size of T.
        path: of the file below the root; the text of a mark.
        content: of W; the target of R, L and S.
    """

    kind: str
    flags: int
    inode: int
    offset: int
    path: str
    content: bytes


@dataclass(frozen=True, slots=True)
class Attributes:
    """Mode and modification time of a file."""

    mode: int
    modified_ns: int


def compiled(source: Path, folder: Path) -> Path:
    """Compile a library for `LD_PRELOAD` into a folder, and return its path."""
    library = folder / source.with_suffix(".so").name
    compiler = sysconfig.get_config_var("CC").split()
    words = [*compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"]
    subprocess.run(words, check=True)
    return library


class Recording:
    """Recorder of the processes that inherit `environment`.

    Attributes:
        attributes: of each inode, at the end.

    Args:
        root: directory whose changes are recorded; must not exist.
        folder: for the library and the log.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.root = root
        self.attributes: Mapping[int, Attributes] = {}
        self._log = folder / "calls"
        library = compiled(_SOURCE, folder)
        root.mkdir()
        self._log.touch()
        self.environment = {
            "LD_PRELOAD": str(library), "CRASH_ROOT": str(root), "CRASH_LOG": str(self._log)
        }  # fmt: skip

    def mark(self, text: str) -> None:
        """Note an answer that the scenario has got."""
        self._add(MARK, text, 0)

    def make(self, *names: str) -> None:
        """Make directories (their names end with `/`) and files of the scenario itself."""
        for name in names:
            path = self.root / name
            path.mkdir() if name.endswith("/") else path.touch()
            self._add("M" if name.endswith("/") else "O", str(path), path.stat().st_ino)

    def _add(self, kind: str, text: str, inode: int) -> None:
        content = text.encode()
        with self._log.open("ab", buffering=0) as log:
            log.write(_HEADER.pack(kind.encode(), 0, len(content), 0, inode, 0) + content)

    def end(self) -> None:
        """Record nothing more; processes that still run are not disturbed."""
        self.attributes = self._attributes()
        self._log.rename(self._log.with_suffix(".ended"))

    def calls(self) -> Iterator[Call]:
        """Yield what was recorded, with paths below the root; raises `ValueError` for a gap."""
        text = self._log.with_suffix(".ended").read_bytes()
        at = 0
        while at < len(text):
            kind, flags, first, second, inode, offset = _HEADER.unpack_from(text, at)
            at += _HEADER.size
            path = text[at : at + first].decode()
            content = text[at + first : at + first + second]
            at += first + second
            if kind == b"?":
                raise ValueError(f"the recorder missed something: {path}")
            if kind in b"RL":
                content = self._below(content.decode()).encode()
            if kind != MARK.encode():
                path = self._below(path)
            yield Call(kind.decode(), flags, inode, offset, path, content)

    def _attributes(self) -> dict[int, Attributes]:
        """Return those of each inode that is there now."""
        found = (path.lstat() for path in self.root.rglob("*"))
        return {one.st_ino: Attributes(stat.S_IMODE(one.st_mode), one.st_mtime_ns) for one in found}

    def _below(self, path: str) -> str:
        return os.path.relpath(os.path.normpath(path), self.root) if path else ""
