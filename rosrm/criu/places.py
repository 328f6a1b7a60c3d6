"""Where a host keeps the images of moves under way, below its slave's directory."""

from __future__ import annotations

from pathlib import Path


def outgoing(state: Path, number: int) -> Path:
    """The image of an instance that is to go elsewhere."""
    return state / "images" / f"out-{number}"


def incoming(state: Path, number: int) -> Path:
    """The image that an instance is restored from."""
    return state / "images" / f"in-{number}"
