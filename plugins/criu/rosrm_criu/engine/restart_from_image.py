"""Start of a process from its newest periodic image, or by its own command if there is none.

The supervisor runs this program instead of the process's own command line, at the first start and
after each crash. The program becomes the shim or the process, so a restart needs neither slave nor
master. If an image cannot be used, the log says so and the process starts without it. For want of
disk space, memory or a descriptor the start fails instead, and the restart policy repeats it.

Standard library only. It runs as `python -I -S restart_from_image.py FOLDER DIRECTORY -- COMMAND`
(see `command`; FOLDER contains `rosrm`), and imports little, because it runs at each start.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

if not __package__:
    sys.path += [str(Path(__file__).resolve().parents[2]), sys.argv.pop(1)]

from rosrm.errors import CriuError, PortableError
from rosrm.shortage import SHORTAGE
from rosrm.wording import reason_of
from rosrm_criu.engine import paths, slots

if TYPE_CHECKING:
    import argparse

    from rosrm_criu.engine.slots import Rejoin

#: Signals that Python handles or ignores by default; ignored ones would stay ignored after execve.
_CHANGED: Final = (signal.SIGPIPE, signal.SIGXFSZ, signal.SIGINT)

#: Errors that say nothing about an image.
_PASSING: Final = frozenset({errno.ENOSPC, errno.EDQUOT}) | SHORTAGE


def command(
    python: str, directory: Path, then: Sequence[str], *, criu: Path, timeout: float
) -> tuple[str, ...]:
    """Return the command line for the supervisor, in place of the process's own.

    Args:
        python: an interpreter.
        directory: of the periodic images; an absolute path, which need not exist.
        then: the process's own command line.
        criu: the CRIU program.
        timeout: seconds for a restore.
    """
    options = [str(directory), f"--criu={criu}", f"--timeout={timeout}"]
    program = str(Path(__file__).resolve())
    return (python, "-I", "-S", program, paths.folder_of_rosrm(), *options, "--", *then)


def main() -> NoReturn:
    """Become the shim that restores the process and stays its parent, or the process itself."""
    end = sys.argv.index("--")
    options, then = _options(sys.argv[1:end]), sys.argv[end + 1 :]
    try:
        found = slots.newest(Path(options.directory))
        if found is not None:
            _restore(*found, options)
    except (CriuError, PortableError, OSError) as error:
        cause = error.__cause__ or error
        if isinstance(cause, OSError) and cause.errno in _PASSING:
            sys.exit(f"not started: its periodic image cannot be used now: {error}")
        sys.stderr.write(f"not started from its periodic image, but without it: {error}\n")
        sys.stderr.flush()
    become(then)


def _options(words: list[str]) -> argparse.Namespace:
    import argparse  # noqa: PLC0415 - a slave, which imports this module too, has no use for it

    parser = argparse.ArgumentParser(
        description="Starts a process from its newest image, or without one."
    )
    parser.add_argument("directory", help="of the images")
    parser.add_argument("--criu", required=True, help="the program")
    parser.add_argument("--timeout", type=float, required=True, help="seconds for the restore")
    return parser.parse_args(words)


def _restore(image: Path, rejoin: Rejoin, options: argparse.Namespace) -> NoReturn:
    """Become the shim; write the request to rejoin first, so that the node rejoins once it runs."""
    from rosrm_criu.control.client import ask_resume, make_directory  # noqa: PLC0415 - likewise
    from rosrm_criu.engine import restore_result  # noqa: PLC0415 - for few of the starts

    control = Path(rejoin.control)
    make_directory(control, rejoin.uid)
    ask_resume(control, None, rejoin.request)
    (image / restore_result.FILE).unlink(missing_ok=True)  # of an earlier start
    slots.count_start(image)  # last, because a start that fails before it says nothing about it
    sys.stderr.write(f"starts from its periodic image {image}\n")
    sys.stderr.flush()
    become(
        restore_result.command(
            sys.executable, image, criu=Path(options.criu), remove=False, timeout=options.timeout
        )
    )


def become(words: Sequence[str]) -> NoReturn:
    """Become another program, with default handling of the signals that Python changes."""
    for number in _CHANGED:
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(words[0], list(words))  # noqa: S606 - as the supervisor would start it
    except OSError as error:
        sys.exit(f"{words[0]} cannot be started: {reason_of(error)}")


if __name__ == "__main__":
    main()
