"""A file system that stops answering, as a dead NFS server: a FUSE file system of one test."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import select
import struct
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

_CLONE_NEWNS = 0x00020000
_MNT_DETACH = 2
_MS_PRIVATE_RECURSIVE = 0x44000
_LOOKUP, _FORGET, _GETATTR, _SETATTR, _MKNOD, _MKDIR, _UNLINK, _RMDIR = 1, 2, 3, 4, 8, 9, 10, 11
_RENAME, _OPEN, _READ, _WRITE, _STATFS, _RELEASE, _FSYNC, _INIT = 12, 14, 15, 16, 17, 18, 20, 26
_OPENDIR, _READDIR, _RELEASEDIR, _CREATE, _INTERRUPT, _BATCH_FORGET = 27, 28, 29, 35, 36, 42
_RENAME2 = 45
_SILENT = (_FORGET, _INTERRUPT, _BATCH_FORGET)
_ROOT = 1
_SET_MODE, _SET_SIZE = 1, 8


class HungFiles:
    """A mounted file system with the content of another directory, while it does not hang.

    Attributes:
        place: its mount point, which this process must not touch after `hang`.
        unanswered: number of requests since then.
    """

    def __init__(self, place: Path, device: int, content: Path) -> None:
        self.place = place
        self.unanswered = 0
        self._device = device
        self._paths = {_ROOT: content}
        self._held: list[bytes] = []
        self._is_hung = False
        self._asleep, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def hang(self) -> None:
        """Take all requests from now on, and answer none: not even SIGKILL ends a caller."""
        self._is_hung = True

    def answer(self) -> None:
        """Answer all requests again, also those since `hang`."""
        os.write(self._wake, b"x")

    def stop(self) -> None:
        """Answer all requests, and end the thread."""
        os.close(self._wake)
        self._thread.join()
        os.close(self._asleep)

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self._device, self._asleep], [], [])
            if self._asleep in ready:
                self._is_hung = False
                held, self._held = self._held, []
                for request in held:
                    self._answer(request)
                if os.read(self._asleep, 1) == b"":
                    return
                continue
            with contextlib.suppress(OSError):  # interrupted, or the file system is unmounted
                self._answer(os.read(self._device, 1 << 20))

    def _answer(self, request: bytes) -> None:
        length, kind, unique, node = struct.unpack_from("<IIQQ", request)
        if kind in _SILENT:
            return
        if self._is_hung:
            self.unanswered += 1
            self._held.append(request)
            return
        try:
            data, fault = self._body(kind, node, request[40:length]), 0
        except OSError as error:
            data, fault = b"", -(error.errno or errno.EIO)
        with contextlib.suppress(OSError):  # its caller is gone
            os.write(self._device, struct.pack("<IiQ", 16 + len(data), fault, unique) + data)

    def _body(self, kind: int, node: int, asked: bytes) -> bytes:
        if kind == _INIT:
            return struct.pack("<IIIIHHIIHHI28x", 7, 31, 1 << 16, 0, 8, 8, 1 << 16, 1, 0, 0, 0)
        if kind == _STATFS:
            return struct.pack("<QQQQQIIII24x", 1, 1, 1, 1, 1, 4096, 255, 4096, 0)
        if kind in (_LOOKUP, _MKNOD, _MKDIR, _CREATE, _UNLINK, _RMDIR, _RENAME, _RENAME2):
            return self._in_directory(kind, self._paths[node], asked)
        if kind in (_READ, _WRITE, _RELEASE, _FSYNC):
            return self._with_file(kind, asked)
        path = self._paths[node]
        if kind == _GETATTR:
            flags, file = struct.unpack_from("<I4xQ", asked)
            return self._attributes(os.fstat(file) if flags & 1 else path.lstat())
        if kind == _SETATTR:
            self._change(path, asked)
            return self._attributes(path.lstat())
        if kind == _OPEN:
            (flags,) = struct.unpack_from("<I", asked)
            return self._opened(os.open(path, flags & os.O_ACCMODE))
        if kind == _OPENDIR:
            return self._opened(0)
        if kind == _READDIR:
            (offset,) = struct.unpack_from("<8xQ", asked)
            names = sorted(one.name for one in path.iterdir())
            return b"".join(map(_entry, enumerate(names[offset:], offset + 1)))
        if kind == _RELEASEDIR:
            return b""
        raise OSError(errno.ENOSYS, "not a call of this file system")

    def _in_directory(self, kind: int, directory: Path, asked: bytes) -> bytes:
        head = {_MKNOD: 16, _MKDIR: 8, _CREATE: 16, _RENAME: 8, _RENAME2: 16}.get(kind, 0)
        names = [os.fsdecode(name) for name in asked[head:].split(b"\0")[:-1]]
        path = directory / names[0]
        if kind in (_UNLINK, _RMDIR):
            (path.unlink if kind == _UNLINK else path.rmdir)()
            return b""
        if kind in (_RENAME, _RENAME2):
            (into,) = struct.unpack_from("<Q", asked)
            target = self._paths[into] / names[1]
            path.rename(target)
            self._paths = {
                node: target / one.relative_to(path) if one.is_relative_to(path) else one
                for node, one in self._paths.items()
            }
            return b""
        opened = b""
        if kind == _MKNOD:
            mode, device = struct.unpack_from("<II", asked)
            os.mknod(path, mode, device)
        elif kind == _MKDIR:
            path.mkdir(struct.unpack_from("<I", asked)[0])
        elif kind == _CREATE:
            flags, mode = struct.unpack_from("<II", asked)
            kept = flags & (os.O_ACCMODE | os.O_EXCL)
            opened = self._opened(os.open(path, kept | os.O_CREAT, mode & 0o7777))
        found = path.lstat()
        node = found.st_ino
        self._paths[node] = path
        return struct.pack("<QQQQII", node, 0, 0, 0, 0, 0) + self._attributes(found)[16:] + opened

    @staticmethod
    def _with_file(kind: int, asked: bytes) -> bytes:
        file, offset, size = struct.unpack_from("<QQI", asked.ljust(20))
        if kind == _READ:
            return os.pread(file, size, offset)
        if kind == _WRITE:
            return struct.pack("<I4x", os.pwrite(file, asked[40 : 40 + size], offset))
        if kind == _RELEASE:
            os.close(file)
        return b""

    @staticmethod
    def _opened(file: int) -> bytes:
        return struct.pack("<QII", file, 1, 0)  # direct I/O: no page stays in the cache

    @staticmethod
    def _change(path: Path, asked: bytes) -> None:
        what, size, mode = struct.unpack_from("<I12xQ44xI", asked)
        if what & _SET_MODE:
            path.chmod(mode & 0o7777)
        if what & _SET_SIZE:
            os.truncate(path, size)

    @staticmethod
    def _attributes(found: os.stat_result) -> bytes:
        times = (int(found.st_atime), int(found.st_mtime), int(found.st_ctime), 0, 0, 0)
        head = (found.st_ino, found.st_size, found.st_blocks, *times)
        rest = (found.st_mode, found.st_nlink, found.st_uid, found.st_gid, found.st_rdev, 4096, 0)
        return struct.pack("<QII", 0, 0, 0) + struct.pack("<QQQQQQIIIIIIIIII", *head, *rest)


def _entry(numbered: tuple[int, str]) -> bytes:
    offset, name = numbered[0], os.fsencode(numbered[1])
    entry = struct.pack("<QQII", offset, offset, len(name), 0) + name
    return entry + bytes(-len(entry) % 8)


@contextlib.contextmanager
def hung_files(place: Path, files: Mapping[str, bytes] | None = None) -> Iterator[HungFiles]:
    """Mount a file system that only this test and its children see; unmount it at the end.

    Processes that wait for it continue then.
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
    content = place.with_name(f"{place.name}.content")
    content.mkdir()
    for name, text in (files or {}).items():
        (content / name).write_bytes(text)
        (content / name).chmod(0o755)
    options = f"fd={device},rootmode=40000,user_id={os.geteuid()},group_id={os.getegid()}"
    if libc.mount(b"hung", os.fsencode(place), b"fuse", 0, options.encode()) != 0:
        os.close(device)
        pytest.skip(f"no FUSE file system can be mounted: {os.strerror(ctypes.get_errno())}")
    mounted = HungFiles(place, device, content)
    try:
        yield mounted
    finally:
        mounted.stop()
        libc.umount2(os.fsencode(place), _MNT_DETACH)
        os.close(device)
