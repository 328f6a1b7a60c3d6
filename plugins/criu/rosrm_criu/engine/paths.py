"""Where a host keeps images, of moves under way and of checkpoints, below its slave's directory."""

from __future__ import annotations

from pathlib import Path

import rosrm


def folder_of_rosrm() -> str:
    """Return the folder in which `rosrm` lies, for a Python that looks nowhere by itself."""
    return str(Path(rosrm.__path__[0]).resolve().parent)


def outgoing(state: Path, number: int) -> Path:
    """The image of an instance that is to go elsewhere."""
    return state / "images" / f"out-{number}"


def incoming(state: Path, number: int) -> Path:
    """The image that an instance is restored from."""
    return state / "images" / f"in-{number}"


def kept(state: Path, number: int) -> Path:
    """The image of an instance that was checkpointed: it lies there until it is restored."""
    return state / "images" / f"kept-{number}"


def ports_of_kept(state: Path, number: int) -> Path:
    """The ports that such an instance had, beside its image."""
    return state / "images" / f"kept-{number}.ports"


def kept_numbers(state: Path) -> list[int]:
    """Of the instances of which there is such an image."""
    names = [path.name.removeprefix("kept-") for path in (state / "images").glob("kept-*")]
    return sorted(int(name) for name in names if name.isdigit())


def periodic(state: Path, number: int) -> Path:
    """The images of an instance that goes on: see `rosrm_criu.engine.slots`."""
    return state / "images" / f"periodic-{number}"


def periodic_numbers(state: Path) -> list[int]:
    """Of the instances of which there are such images."""
    names = [path.name.removeprefix("periodic-") for path in (state / "images").glob("periodic-*")]
    return sorted(int(name) for name in names if name.isdigit())
