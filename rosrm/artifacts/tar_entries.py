"""Entries of an archive whose headers are bounded. The content is not trusted.

`tarfile` reads an extended header of any length into memory, and follows the parts of a sparse
file, before a caller sees the entry.
"""

from __future__ import annotations

import tarfile
from typing import Any, Final

#: Maximum bytes of an extended header: a name and the target of a link, of 4096 bytes each.
LARGEST_HEADER: Final = 1 << 14
_PLAIN: Final = (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE, tarfile.SYMTYPE)
_EXTENDED: Final = (tarfile.XHDTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)


class BoundedEntry(tarfile.TarInfo):
    """An entry of an archive; one of another kind, or with a long header, is refused."""

    def _proc_member(self, archive: tarfile.TarFile) -> Any:
        if self.type in _EXTENDED and self.size > LARGEST_HEADER:
            raise tarfile.ReadError(
                f"a header has {self.size} bytes; at most {LARGEST_HEADER} are allowed"
            )
        if self.type not in (*_PLAIN, *_EXTENDED):
            raise tarfile.ReadError(f"{self.name!r:.200} is neither a file, a directory nor a link")
        return super()._proc_member(archive)  # type: ignore[misc]

    def _refuse_sparse(self, *_: Any) -> None:
        raise tarfile.ReadError(f"{self.name!r:.200} is a sparse file")

    _proc_gnusparse_00 = _proc_gnusparse_01 = _proc_gnusparse_10 = _refuse_sparse
