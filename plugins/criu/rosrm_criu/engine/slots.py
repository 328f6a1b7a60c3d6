"""Periodic images of a running process, which restarts from the newest of them after a crash.

    images/periodic-NUMBER/1, 2, ...    one image each; the file `rejoin.json` makes it valid

Only a node that has left the ROS graph is dumped this way, and it rejoins as a new participant. So
its peers treat its messages as new, however often one image is used.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.runtime import durable
from rosrm.shortage import exists, status

_REJOIN: Final = "rejoin.json"
_STARTS: Final = "starts"
_IGNORE_IMAGES: Final = "anew"
#: Most starts from one image. A process that crashes more often without a newer image may crash
#: because of its restored memory, so it then starts without an image.
_MOST_STARTS: Final = 2


@dataclass(frozen=True)
class Rejoin:
    """Parameters for the rejoin of a node that is restored from an image.

    Attributes:
        control: its control directory.
        request: id of the request to leave.
        uid: the user that it runs as.
    """

    control: str
    request: str
    uid: int


def new_slot(parent: Path) -> Path:
    """Return the path of the next image, which does not exist yet."""
    numbers = [int(path.name) for path in _slots(parent)]
    return parent / str(max(numbers, default=0) + 1)


def complete(slot: Path, rejoin: Rejoin) -> None:
    """Make an image valid, so that the process starts from it, and remove older images.

    The image is forced to the disk first, because otherwise a loss of power might leave no image.
    """
    durable.sync(str(slot))
    durable.replace_durably(str(slot / _REJOIN), json.dumps(asdict(rejoin)).encode())
    durable.sync_directory(str(slot.parent))
    for other in _slots(slot.parent):
        if other != slot:
            shutil.rmtree(other, ignore_errors=True)


def discard_unfinished(parent: Path) -> None:
    """Remove the images of interrupted dumps."""
    for slot in _slots(parent):
        if not exists(slot / _REJOIN):
            shutil.rmtree(slot, ignore_errors=True)


def start_without_image(parent: Path) -> None:
    """Make the next start ignore all images, including one that is being made."""
    if exists(parent):
        (parent / _IGNORE_IMAGES).touch()


def newest(parent: Path) -> tuple[Path, Rejoin] | None:
    """Return the image to start from; None: start without an image.

    Raises:
        CriuError: an image is damaged.
        OSError: no look at an image is possible now.
    """
    if exists(parent / _IGNORE_IMAGES):
        for slot in _slots(parent):
            shutil.rmtree(slot, ignore_errors=True)
        if not _slots(parent):  # otherwise a later start would use an image that is left
            shutil.rmtree(parent, ignore_errors=True)
        return None
    for slot in _slots(parent):
        try:
            rejoin = Rejoin(**json.loads((slot / _REJOIN).read_text(encoding="utf-8")))
        except FileNotFoundError:
            continue  # the dump is under way, or was interrupted
        except (ValueError, TypeError) as error:
            raise CriuError(f"the periodic image {slot} is damaged: {_REJOIN}: {error}") from None
        counted = status(slot / _STARTS)
        return None if counted and counted.st_size >= _MOST_STARTS else (slot, rejoin)
    return None


def count_start(slot: Path) -> None:
    """Append one byte per start, which cannot be half written; raise OSError on a full disk."""
    with (slot / _STARTS).open("ab") as file:
        file.write(b".")


def _slots(parent: Path) -> list[Path]:
    """Return the images, newest first."""
    found: list[Path] = []
    with contextlib.suppress(FileNotFoundError):
        found = [path for path in parent.iterdir() if path.name.isdigit()]
    return sorted(found, key=lambda path: int(path.name), reverse=True)
