"""Wall clocks of master, slaves and their children, by libfaketime; never the machine's own.

The PyPI package `libfaketime` brings the shared object; without it no clock is set back. Each part
has a file with the offset of its clock (+ ahead, - behind, s). libfaketime reads it every second.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

_INSIDE: Final = Path("vendor/libfaketime/src/libfaketime.so.1")


def library() -> Path | None:
    """Return the shared object of libfaketime; None: not installed."""
    found = importlib.util.find_spec("libfaketime")  # without importing it
    if found is None or found.origin is None:
        return None
    path = Path(found.origin).parent / _INSIDE
    return path if path.is_file() else None


def with_clock(folder: Path, part: str, command: Sequence[str]) -> list[str]:
    """Return the command of a part, changed such that the part and its children share a fake clock.

    Only the part itself gets the variables, not the program that enters its host. libfaketime makes
    files in /dev/shm. A killed process leaves its files there; removing the host removes them.
    """
    path = library()
    if path is None:
        return list(command)
    variables = {
        "LD_PRELOAD": str(path),
        "FAKETIME_TIMESTAMP_FILE": str(_file(folder, part)),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_FORCE_MONOTONIC_FIX": "0",  # otherwise a wait by the monotonic clock spins
        "NO_FAKE_STAT": "1",
    }
    return ["env", *(f"{name}={value}" for name, value in variables.items()), *command]


def set_back(folder: Path, part: str, seconds: float) -> None:
    """Set the clock of a part back by so many seconds; 0 corrects it."""
    file = _file(folder, part)
    new = file.with_suffix(".new")
    new.write_text(f"{-seconds:+.2f}\n")
    new.replace(file)  # a reader sees the old content or the new one


def reset(folder: Path, parts: Iterable[str]) -> None:
    """Correct all clocks."""
    for part in parts:
        set_back(folder, part, 0.0)


def _file(folder: Path, part: str) -> Path:
    return folder / f"clock-{part}"
