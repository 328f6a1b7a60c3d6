"""How a restore went, as the program that holds the restored process tells it; and how it starts.

It tells by a file beside the image, for it is nobody's child but the supervisor's.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm_criu.engine import paths

#: Below the directory of the image.
FILE: Final = "hold.json"

#: What ends a wait is a file: nothing tells of it but a look.
_LOOK: Final = 0.005


@dataclass(frozen=True)
class Outcome:
    """How a restore went.

    Args:
        reason: why it failed; "": it did not.
        pid: of the restored process, as those see it who started the hold.
        inner_pid: as it sees itself: what it had where it was dumped (Fast DDS writes it into the
            GIDs of endpoints).
        namespace: it has a pid namespace of its own, and ends with its hold at once.
        seconds: that the restore took, from the start of the hold.
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
    """The command line that the supervisor is given in place of the process's own.

    Without site-packages (-S), as the supervisor itself: 0.07 s sooner with the ROS wheels.

    Args:
        python: an interpreter.
        directory: of the image; an absolute path.
        criu: the program.
        remove: the image goes as soon as the process is restored. The directory stays, with what
            was told: whoever looks later, however short that life was, sees that it was used up.
        timeout: seconds for the restore.
        then: the process's own command line, which runs when this is started again after the end of
            the restored process: an image is for one life. What was told says that there was one,
            so the directory has to stay as long as the instance may be started again.
    """
    program = str(Path(__file__).resolve().with_name("shim.py"))
    words = [python, "-I", "-S", program, paths.folder_of_rosrm(), str(directory)]
    words += [f"--criu={criu}", f"--timeout={timeout}"]
    words += ["--remove"] if remove else []
    return (*words, "--", *then) if then else tuple(words)


def write(directory: Path, outcome: Outcome) -> None:
    """Tell it, in one step."""
    new = directory / f"{FILE}.new"
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        json.dump(asdict(outcome), file)
    new.replace(directory / FILE)


def read(directory: Path) -> Outcome | None:
    """What was told; None: nothing yet. Raises CriuError for what nobody can read."""
    try:
        return Outcome(**json.loads((directory / FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise CriuError(f"{directory / FILE} cannot be read: {error}") from None


def wait(directory: Path, *, timeout: float, ended: Callable[[], bool] = lambda: False) -> Outcome:
    """Wait for the outcome of a restore; not to be called in a loop that others wait for.

    Args:
        directory: of the image.
        timeout: seconds.
        ended: whether the hold has ended, however that was noticed.

    Raises:
        CriuError: the restore failed, or nothing was heard of it.
    """
    end = time.monotonic() + timeout
    while True:
        is_over = ended()  # asked first: what it told before its end is there then
        outcome = read(directory)
        if outcome is not None:
            break
        if is_over:
            raise CriuError(f"the restore of {directory} ended without a result")
        if time.monotonic() > end:
            raise CriuError(f"the restore of {directory} has not reported for {timeout:g} s")
        time.sleep(_LOOK)
    if outcome.reason:
        raise CriuError(outcome.reason)
    return outcome
