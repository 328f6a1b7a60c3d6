"""A file system that stops answering, as a dead NFS server: a FUSE file system of one test."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import select
import stat
import struct
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

_CLONE_NEWNS = 0x00020000
_MNT_DETACH = 2
_MS_PRIVATE_RECURSIVE = 0x44000
_LOOKUP, _GETATTR, _OPEN, _READ, _STATFS, _INIT, _OPENDIR, _READDIR = 1, 3, 14, 15, 17, 26, 27, 28
_FORGET, _RELEASE, _FLUSH, _RELEASEDIR, _INTERRUPT, _BATCH_FORGET = 2, 18, 25, 29, 36, 42
_SILENT = (_FORGET, _INTERRUPT, _BATCH_FORGET)
_ROOT = 1


class HungFiles:
    """A mounted file system with a few files, until it hangs.

    Attributes:
        place: its mount point, which this process must not touch after `hang`.
        unanswered: number of requests since then.
    """

    def __init__(self, place: Path, device: int, files: Mapping[str, bytes]) -> None:
        self.place = place
        self.unanswered = 0
        self._device = device
        self._names = {_ROOT + 1 + at: name for at, name in enumerate(files)}
        self._files = dict(files)
        self._is_hung = False
        self._asleep, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def hang(self) -> None:
        """Take all requests from now on, and answer none: not even SIGKILL ends a caller."""
        self._is_hung = True

    def stop(self) -> None:
        """End the thread."""
        os.close(self._wake)
        self._thread.join()
        os.close(self._asleep)

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self._device, self._asleep], [], [])
            if self._asleep in ready:
                return
            try:
                self._answer(os.read(self._device, 1 << 20))
            except OSError:  # the request was interrupted, or the file system is unmounted
                if self._asleep in select.select([self._asleep], [], [], 0.01)[0]:
                    return

    def _answer(self, request: bytes) -> None:
        length, kind, unique, node = struct.unpack_from("<IIQQ", request)
        if kind in _SILENT:
            return
        if self._is_hung:
            self.unanswered += 1
            return
        body = self._body(kind, node, request[40:length])
        fault = -body if isinstance(body, int) else 0
        data = b"" if isinstance(body, int) else body
        os.write(self._device, struct.pack("<IiQ", 16 + len(data), fault, unique) + data)

    def _body(self, kind: int, node: int, asked: bytes) -> bytes | int:
        if kind == _INIT:
            return struct.pack("<IIIIHHIIHHI28x", 7, 31, 1 << 16, 0, 8, 8, 1 << 16, 1, 0, 0, 0)
        if kind == _LOOKUP:
            name = asked.split(b"\0")[0].decode()
            found = [number for number, one in self._names.items() if one == name]
            if not found:
                return errno.ENOENT
            return struct.pack("<QQQQII", found[0], 0, 0, 0, 0, 0) + self._attributes(found[0])
        if kind == _GETATTR:
            return struct.pack("<QII", 0, 0, 0) + self._attributes(node)
        if kind in (_OPEN, _OPENDIR):
            return struct.pack("<QII", 0, 1, 0)  # direct I/O: no page stays in the cache
        if kind == _READ:
            offset, size = struct.unpack_from("<8xQI", asked)
            return self._files[self._names[node]][offset : offset + size]
        if kind == _STATFS:
            return struct.pack("<QQQQQIIII24x", 1, 1, 1, 1, 1, 4096, 255, 4096, 0)
        if kind in (_READDIR, _RELEASE, _FLUSH, _RELEASEDIR):
            return b""
        return errno.ENOSYS

    def _attributes(self, node: int) -> bytes:
        is_root = node == _ROOT
        size = 0 if is_root else len(self._files[self._names[node]])
        mode = stat.S_IFDIR | 0o755 if is_root else stat.S_IFREG | 0o755
        head = (node, size, 0, 0, 0, 0, 0, 0, 0, mode, 1 + is_root, os.geteuid(), os.getegid())
        return struct.pack("<QQQQQQIIIIIIIIII", *head, 0, 4096, 0)


@contextlib.contextmanager
def hung_files(place: Path, files: Mapping[str, bytes] | None = None) -> Iterator[HungFiles]:
    """Mount a file system that only this test and its children see; unmount it at the end.

    Processes that wait for it continue, with errors, when the device is closed.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if os.geteuid() != 0 or libc.unshare(_CLONE_NEWNS) != 0:
        pytest.skip("only root may mount a file system that hangs")
    libc.mount(b"none", b"/", None, _MS_PRIVATE_RECURSIVE, None)
    try:
        device = os.open("/dev/fuse", os.O_RDWR)
    except OSError as error:
        pytest.skip(f"/dev/fuse: {error.strerror}")
    place.mkdir(parents=True)
    options = f"fd={device},rootmode=40000,user_id={os.geteuid()},group_id={os.getegid()}"
    if libc.mount(b"hung", os.fsencode(place), b"fuse", 0, options.encode()) != 0:
        os.close(device)
        pytest.skip(f"no FUSE file system can be mounted: {os.strerror(ctypes.get_errno())}")
    mounted = HungFiles(place, device, files or {})
    try:
        yield mounted
    finally:
        mounted.stop()
        libc.umount2(os.fsencode(place), _MNT_DETACH)
        os.close(device)
