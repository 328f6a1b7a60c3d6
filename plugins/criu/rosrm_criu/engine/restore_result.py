"""Result file and command line of the shim.

The shim reports by a file beside the image, because it is a child of the supervisor alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm_criu.engine import paths

#: Name of the file below the directory of the image.
FILE: Final = "hold.json"

#: Seconds between two reads of the file; the standard library cannot wait for a file.
_LOOK: Final = 0.002


@dataclass(frozen=True)
class Outcome:
    """Result of a restore.

    Args:
        reason: cause of the failure; "": the restore succeeded.
        pid: of the restored process, in the pid namespace of the shim's parent.
        inner_pid: in its own namespace, equal to the pid at the dump (Fast DDS writes it into the
            GIDs of endpoints).
        namespace: the process has its own pid namespace, so it dies with its shim at once.
        seconds: duration of the restore, from the start of the shim.
    """

    reason: str = ""
    pid: int = 0
    inner_pid: int = 0
    namespace: bool = True
    seconds: float = 0.0


def command(
    python: str, directory: Path, *, criu: Path, remove: bool, timeout: float,
    then: Sequence[str] = (),
) -> tuple[str, ...]:  # fmt: skip
    """Return the command line for the supervisor, in place of the process's own.

    Without site-packages (-S), like the supervisor itself: 0.07 s faster with the ROS wheels.

    Args:
        python: an interpreter.
        directory: of the image; an absolute path.
        criu: the CRIU program.
        remove: remove the image as soon as the process is restored. The directory stays with the
            result, so that later readers see that the image was used, even if the process ended
            soon.
        timeout: seconds for the restore.
        then: the process's own command line, for a restart after the restored process has ended:
            an image is restored only once. The result shows that it was, so the directory must
            stay as long as the instance may be restarted.
    """
    program = str(Path(__file__).resolve().with_name("shim.py"))
    words = [python, "-I", "-S", program, paths.folder_of_rosrm(), str(directory)]
    words += [f"--criu={criu}", f"--timeout={timeout}"]
    words += ["--remove"] if remove else []
    return (*words, "--", *then) if then else tuple(words)


def write(directory: Path, outcome: Outcome) -> None:
    """Write the result atomically."""
    new = directory / f"{FILE}.new"
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        json.dump(asdict(outcome), file)
    new.replace(directory / FILE)


def read(directory: Path) -> Outcome | None:
    """Return the result; None: there is none yet.

    Raises:
        CriuError: it is damaged.
        OSError: no look is possible now, so the process may have been restored.
    """
    try:
        text = (directory / FILE).read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return Outcome(**json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise CriuError(f"{directory / FILE} is damaged: {error}") from None


def was_restored(directory: Path) -> bool:
    """Return True if a process was restored from an image, even if it has ended since.

    Raises:
        OSError: as `read`. A caller that took this for False would end the process, remove the only
            record of its restore, or restore its image a second time.
    """
    with contextlib.suppress(CriuError):
        outcome = read(directory)
        return outcome is not None and not outcome.reason
    return False


def wait(directory: Path, *, timeout: float, ended: Callable[[], bool] = lambda: False) -> Outcome:
    """Wait for the result of a restore; do not call this in an event loop.

    Args:
        directory: of the image.
        timeout: seconds.
        ended: returns True once the shim has ended.

    Raises:
        CriuError: the restore failed, or there is no result in time.
        OSError: no look at the result was possible until then, so the restore may have succeeded.
    """
    end = clocks.boot_time() + timeout
    while True:
        try:
            is_over = ended()  # first, because a result written before the end is then found
            outcome = read(directory)
        except OSError:
            if clocks.boot_time() > end:
                raise
            time.sleep(_LOOK)
            continue
        if outcome is not None:
            break
        if is_over:
            raise CriuError(f"the restore of {directory} ended without a result")
        if clocks.boot_time() > end:
            raise CriuError(f"the restore of {directory} has not reported for {timeout:g} s")
        time.sleep(_LOOK)
    if outcome.reason:
        raise CriuError(outcome.reason)
    return outcome
