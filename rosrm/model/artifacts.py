"""Artifacts: files and directories of the submitting machine that a process gets on its host."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

#: Highest number of artifacts of one process.
MOST_ARTIFACTS: Final = 256
#: Most bytes of one artifact.
LARGEST_ARTIFACT: Final = 10**13
#: Variable with the directory of the artifacts of a process.
ARTIFACTS_VARIABLE: Final = "ROSRM_ARTIFACTS"
#: Rate in bytes a second that a move of a process expects of the network at least.
_SLOWEST_RATE: Final = 1e6

_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_LONGEST_NAME: Final = 1024
_LONGEST_PART: Final = 255


@dataclass(frozen=True, slots=True)
class Artifact:
    """A file or directory that a process gets on its host.

    Attributes:
        name: relative path below the directory of the process's artifacts.
        digest: SHA-256 of its archive in hexadecimal digits; "": not computed yet.
        size: bytes of its archive.
        source: path on the submitting machine; "" on all others.
    """

    name: str
    digest: str = ""
    size: int = 0
    source: str = field(default="", compare=False)


def is_digest(text: str) -> bool:
    """Return True for a digest in the form of `Artifact.digest`."""
    return _DIGEST.fullmatch(text) is not None


def name_fault(name: str) -> str:
    """Return why a text cannot be the name of an artifact, or of an entry of one; "" if it can."""
    parts = name.split("/")
    if name.startswith("/"):
        return f"{name!r:.200} is absolute; a path relative to the artifacts is required"
    if ".." in parts:
        return f"{name!r:.200} has '..', and would lie outside of the artifacts"
    if not all(parts) or "." in parts:
        return f"{name!r:.200} is no plain relative path such as models/model.onnx"
    if "\0" in name or len(name) > _LONGEST_NAME or max(map(len, parts)) > _LONGEST_PART:
        return (
            f"{name!r:.200} is too long, or has a zero byte; allowed: {_LONGEST_NAME} characters, "
            f"{_LONGEST_PART} between two slashes"
        )
    return ""


def artifacts_fault(artifacts: Iterable[Artifact]) -> str:
    """Return why a process cannot have these artifacts, apart from their contents; "" if it can."""
    names: set[str] = set()
    for one in artifacts:
        fault = name_fault(one.name)
        if not fault and not one.name.isprintable():
            fault = f"{one.name!r:.200} has characters that cannot be printed"
        if not fault and one.name in names:
            fault = f"{one.name!r:.200} is given twice"
        if fault:
            return fault
        names.add(one.name)
    if len(names) > MOST_ARTIFACTS:
        return f"{len(names)} are given; at most {MOST_ARTIFACTS}"
    for name in names:
        parts = name.split("/")
        for end in range(1, len(parts)):
            if (above := "/".join(parts[:end])) in names:
                return f"{name!r:.200} lies in {above!r:.200}, which is another artifact"
    return ""


def contents_fault(artifacts: Iterable[Artifact]) -> str:
    """Return why a spec with these artifacts cannot run, because of digests or sizes; "": none."""
    for one in artifacts:
        if not is_digest(one.digest):
            return f"{one.name!r:.200} has no digest; submit it with `rosrm submit`"
        if not 0 < one.size <= LARGEST_ARTIFACT:
            return f"{one.name!r:.200} has {one.size} bytes; allowed: 1 to {LARGEST_ARTIFACT}"
    return ""


def set_key(artifacts: Iterable[Artifact]) -> str:
    """Return the name of the directory in which a host puts together a set of artifacts."""
    from hashlib import sha256  # noqa: PLC0415 - half a MiB, which nodes do not need

    text = "".join(f"{one.digest} {one.name}\0" for one in artifacts)
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def fetch_time(artifacts: Iterable[Artifact]) -> float:
    """Return the seconds within which a host must fetch artifacts while a process moves to it."""
    return sum(one.size for one in artifacts) / _SLOWEST_RATE


def artifacts_of(artifacts: Mapping[str, str]) -> tuple[Artifact, ...]:
    """Return the artifacts in a mapping from names to paths, in the order of their names."""
    return tuple(Artifact(name, source=path) for name, path in sorted(artifacts.items()))
