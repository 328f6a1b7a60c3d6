"""Small file systems, one per test, which a test can fill to the last byte."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

_CLONE_NEWNS = 0x00020000


class Disk:
    """A file system of 1 MiB.

    Attributes:
        place: its mount point.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self._filler = place / "filler"

    def fill(self, but: int = 0) -> None:
        """Fill the file system, until only `but` more bytes fit."""
        with self._filler.open("ab", buffering=0) as filler:
            for size in (65536, 4096, 1):
                while self._fits(filler, size):
                    pass
            filler.truncate(filler.tell() - but)

    @staticmethod
    def _fits(filler, size: int) -> bool:
        try:
            return filler.write(bytes(size)) == size
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            return False

    def make_room(self) -> None:
        self._filler.unlink(missing_ok=True)


@contextlib.contextmanager
def small_disk(place: Path, *options: str, size: str = "1m") -> Iterator[Disk]:
    """Mount a small tmpfs that only this test and its children see; unmount it at the end."""
    place.mkdir(parents=True)
    if os.geteuid() != 0 or ctypes.CDLL(None).unshare(_CLONE_NEWNS) != 0:
        pytest.skip("only root may mount a small file system")
    subprocess.run(["mount", "--make-rprivate", "/"], check=True)
    chosen = ",".join((f"size={size},mode=700", *options))
    subprocess.run(["mount", "-t", "tmpfs", "-o", chosen, "tmpfs", place], check=True)
    try:
        yield Disk(place)
    finally:
        subprocess.run(["umount", "-l", place], check=True)
