"""Reasons for programs that cannot be executed, from the error and the first bytes of the file."""

from __future__ import annotations

import errno
import os
import struct
from typing import Final

from rosrm.wording import reason_of

#: Maximum bytes of the first line that the kernel reads, and of the head of an ELF file.
_FIRST_LINE: Final = 256
_HEAD: Final = 1 << 16
#: Machine in an ELF header to its name, as of `uname -m`.
_MACHINES: Final = {
    3: "i686", 8: "mips", 20: "ppc", 21: "ppc64", 22: "s390x", 40: "armv7l", 62: "x86_64",
    183: "aarch64", 243: "riscv64", 258: "loongarch64",
}  # fmt: skip
#: Bytes of the shortest header, and the type of a program header that names the loader.
_ELF_HEADER: Final = 52
_PT_INTERP: Final = 3


def reason(path: str, error: OSError) -> str:
    """Return why a program could not be executed."""
    if error.errno == errno.ENOENT and not os.path.exists(path):
        if os.path.islink(path):
            return f"{path} is a link to {os.readlink(path)!r}, which does not exist"
        return f"no executable {path!r} exists"
    return f"{path} cannot be started: {_cause(path, error)}"


def _cause(path: str, error: OSError) -> str:
    try:
        if error.errno == errno.EACCES:
            return _denied(path)
        head = _head(path)
    except OSError:
        head = b""
    if head.startswith(b"#!"):
        interpreter = _interpreter(head)
        if error.errno in (errno.ENOENT, errno.ENOEXEC) and not interpreter:
            return "its first line, #!, names no interpreter"
        if error.errno == errno.ENOENT:
            carriage = "; the line ends with a carriage return" * interpreter.endswith("\r")
            return f"the interpreter in its first line does not exist: {interpreter!r}{carriage}"
    elif head.startswith(b"\x7fELF"):
        if error.errno == errno.ENOENT:
            return f"its loader does not exist on this host: {_loader(head)!r}"
        machine = _machine(head)
        if error.errno == errno.ENOEXEC and machine not in ("", os.uname().machine):
            return f"it is a program for {machine}, and this host is {os.uname().machine}"
        if error.errno in (errno.ENOEXEC, errno.EINVAL):
            return "its file begins like a program (ELF), but is damaged or is not one"
    elif error.errno == errno.ENOEXEC:
        return f"it is neither a program nor a script with #!{' (it is empty)' * (not head)}"
    return reason_of(error)


def _denied(path: str) -> str:
    """Return why a file may not be executed. Raises OSError."""
    if os.path.isdir(path):
        return "it is a directory"
    if os.statvfs(path).f_flag & os.ST_NOEXEC:
        return "it is on a file system that is mounted with noexec"
    if not os.path.isfile(path):
        return "it is no regular file"
    if not os.access(path, os.X_OK):
        return "it is not executable (`chmod +x`)"
    interpreter = _interpreter(_head(path))
    if interpreter:
        return f"the interpreter in its first line is not executable: {interpreter!r}"
    return "it may not be executed here"


def _head(path: str) -> bytes:
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        return os.read(file, _HEAD)
    finally:
        os.close(file)


def _interpreter(head: bytes) -> str:
    """Return the interpreter in the first line of a script; "": there is none."""
    if not head.startswith(b"#!"):
        return ""
    line = head[2:_FIRST_LINE].split(b"\n")[0].strip(b" \t")
    return os.fsdecode(line.replace(b"\t", b" ").split(b" ")[0])  # a carriage return belongs to it


def _machine(head: bytes) -> str:
    """Return the machine that an ELF file names; "": the file is too short."""
    if len(head) < _ELF_HEADER:
        return ""
    order = ">" if head[5:6] == b"\2" else "<"
    number = struct.unpack_from(f"{order}H", head, 18)[0]
    return _MACHINES.get(number, f"machine {number}")


def _loader(head: bytes) -> str:
    """Return the loader that an ELF file names; "": it cannot be read."""
    order, wide = (">" if head[5:6] == b"\2" else "<"), head[4:5] == b"\2"
    try:
        offset = struct.unpack_from(f"{order}{'Q' if wide else 'I'}", head, 32 if wide else 28)[0]
        size, count = struct.unpack_from(f"{order}HH", head, 54 if wide else 42)
        for at in range(offset, offset + size * count, size):
            if struct.unpack_from(f"{order}I", head, at)[0] == _PT_INTERP:
                layout, place = ("Q", at + 8) if wide else ("I", at + 4)
                start = struct.unpack_from(f"{order}{layout}", head, place)[0]
                return os.fsdecode(head[start:].split(b"\0")[0])
    except (struct.error, ValueError):
        pass
    return ""
