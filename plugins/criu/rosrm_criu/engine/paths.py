"""Paths of a host's images, of moves under way and of checkpoints, below the slave's directory."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import rosrm
from rosrm.shortage import names


def folder_of_rosrm() -> str:
    """Return the folder that contains `rosrm`, for a Python that runs without site-packages."""
    return str(Path(rosrm.__path__[0]).resolve().parent)


def outgoing(state: Path, number: int) -> Path:
    """Return the path of the image of an instance that moves to another host."""
    return state / "images" / f"out-{number}"


def incoming(state: Path, number: int) -> Path:
    """Return the path of the image that an instance is restored from."""
    return state / "images" / f"in-{number}"


def sent_copy(state: Path, number: int) -> Path:
    """Return the path of the copy of an instance's memory that is sent before its dump."""
    return state / "images" / f"copy-out-{number}"


def received_copy(state: Path, number: int) -> Path:
    """Return the path of the copy of the memory of the instance that will move here."""
    return state / "images" / f"copy-in-{number}"


def checkpoint(state: Path, number: int) -> Path:
    """Return the path of the checkpoint of an instance; the image stays there until the restore."""
    return state / "images" / f"kept-{number}"


def checkpoint_ports(state: Path, number: int) -> Path:
    """Return the path of the file with the ports of a checkpointed instance, beside its image."""
    return state / "images" / f"kept-{number}.ports"


def periodic(state: Path, number: int) -> Path:
    """Return the directory of a running instance's images: see `rosrm_criu.engine.slots`."""
    return state / "images" / f"periodic-{number}"


#: Kinds of images and memory copies: the prefix of the names of their directories.
ImageKind = Literal["out", "in", "kept", "periodic", "copy-out", "copy-in"]


def numbers(state: Path, kind: ImageKind) -> list[int]:
    """Return the numbers of the instances that have an image of a kind."""
    parts = (name.rpartition("-") for name in names(state / "images"))
    return sorted(int(number) for found, _, number in parts if found == kind and number.isdigit())
