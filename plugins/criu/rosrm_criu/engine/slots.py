"""Periodic images: of a process that goes on, which starts from the newest of them after a crash.

    images/periodic-NUMBER/1, 2, ...    each an image, with a file `rejoin.json` that makes it count

Only a node that has left the ROS graph is dumped so, and that joins it as a new participant: its
peers take what it says for new, however often one image is used. Standard library alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError

_REJOIN: Final = "rejoin.json"
_STARTS: Final = "starts"
_ANEW: Final = "anew"
#: Starts from one image. A process that has crashed so often with no newer one behind it may do so
#: for what it remembers: then it begins anew.
_MOST_STARTS: Final = 2


@dataclass(frozen=True)
class Rejoin:
    """How a node that was restored from an image is told to join the ROS graph.

    Attributes:
        control: directory in which it is spoken to.
        request: id by which it was asked to leave.
        uid: of the user that it runs as.
    """

    control: str
    request: str
    uid: int


def new_slot(parent: Path) -> Path:
    """Where the next image goes; nothing is there."""
    numbers = [int(path.name) for path in _slots(parent)]
    return parent / str(max(numbers, default=0) + 1)


def complete(slot: Path, rejoin: Rejoin) -> None:
    """From now on the process starts from this image; older ones go."""
    new = slot / f"{_REJOIN}.new"
    new.touch(mode=0o600)
    new.write_text(json.dumps(asdict(rejoin)), encoding="utf-8")
    new.replace(slot / _REJOIN)
    for other in _slots(slot.parent):
        if other != slot:
            shutil.rmtree(other, ignore_errors=True)


def discard_unfinished(parent: Path) -> None:
    """Remove what a dump that was cut off has left."""
    for slot in _slots(parent):
        if not (slot / _REJOIN).exists():
            shutil.rmtree(slot, ignore_errors=True)


def begin_anew(parent: Path) -> None:
    """The next start is from no image, nor from one that is being made just now."""
    if parent.exists():
        (parent / _ANEW).touch()


def newest(parent: Path) -> tuple[Path, Rejoin] | None:
    """The image to start from, which counts as a start; None: begin anew.

    Raises:
        CriuError: what is there cannot be read, or not be counted.
    """
    if (parent / _ANEW).exists():
        shutil.rmtree(parent, ignore_errors=True)
        return None
    for slot in _slots(parent):
        try:
            rejoin = Rejoin(**json.loads((slot / _REJOIN).read_text(encoding="utf-8")))
        except FileNotFoundError:
            continue  # a dump that is under way, or was cut off
        except (OSError, ValueError, TypeError) as error:
            raise CriuError(f"the periodic image {slot} is damaged: {_REJOIN}: {error}") from None
        return (slot, rejoin) if _count_start(slot) <= _MOST_STARTS else None
    return None


def _count_start(slot: Path) -> int:
    """One byte for each: that cannot be half written."""
    try:
        with (slot / _STARTS).open("ab") as file:
            file.write(b".")
            file.flush()
            return os.fstat(file.fileno()).st_size
    except OSError as error:
        raise CriuError(f"the periodic image {slot} cannot be used: {error.strerror}") from None


def _slots(parent: Path) -> list[Path]:
    """The newest first."""
    found: list[Path] = []
    with contextlib.suppress(FileNotFoundError):
        found = [path for path in parent.iterdir() if path.name.isdigit()]
    return sorted(found, key=lambda path: int(path.name), reverse=True)
