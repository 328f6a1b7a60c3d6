"""Starts a process from its newest periodic image, or as its command says where there is none.

The supervisor starts this program in place of the process's own command line, at first and after
each crash; it becomes the one or the other. So neither slave nor master is needed for it. What
cannot be used is said in the log, and then the process begins anew: as it would without images.

Standard library only; it runs as `python -I -S restart_from_image.py FOLDER DIRECTORY -- COMMAND`
(see `command`; `rosrm` lies in FOLDER), and loads little, as it runs at each start.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

if not __package__:
    sys.path += [str(Path(__file__).resolve().parents[2]), sys.argv.pop(1)]

from rosrm.errors import CriuError, PortableError
from rosrm_criu.engine import paths, slots

if TYPE_CHECKING:
    from rosrm_criu.engine.slots import Rejoin


def command(
    python: str, directory: Path, then: Sequence[str], *, criu: Path, timeout: float
) -> tuple[str, ...]:
    """The command line that the supervisor is given in place of the process's own.

    Args:
        python: an interpreter.
        directory: of its periodic images; an absolute path, which need not exist.
        then: the process's own command line.
        criu: the program.
        timeout: seconds for a restore.
    """
    options = [str(directory), f"--criu={criu}", f"--timeout={timeout}"]
    program = str(Path(__file__).resolve())
    return (python, "-I", "-S", program, paths.folder_of_rosrm(), *options, "--", *then)


def main() -> NoReturn:
    """Become the program that restores and holds the process, or the process."""
    end = sys.argv.index("--")
    options, then = _options(sys.argv[1:end]), sys.argv[end + 1 :]
    try:
        found = slots.newest(Path(options.directory))
        if found is not None:
            _restore(*found, options)
    except (CriuError, PortableError) as error:
        sys.stderr.write(f"not started from its periodic image, but without it: {error}\n")
        sys.stderr.flush()
    _become(then)


def _options(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Starts a process from its newest image, or without one."
    )
    parser.add_argument("directory", help="of the images")
    parser.add_argument("--criu", required=True, help="the program")
    parser.add_argument("--timeout", type=float, required=True, help="seconds for the restore")
    return parser.parse_args(words)


def _restore(image: Path, rejoin: Rejoin, options: argparse.Namespace) -> NoReturn:
    """It joins as soon as it runs: who asks it is told beforehand."""
    from rosrm_criu.control import ask_resume, make_directory  # noqa: PLC0415 - likewise
    from rosrm_criu.engine import restore_result  # noqa: PLC0415 - for few of the starts

    control = Path(rejoin.control)
    make_directory(control, rejoin.uid)
    ask_resume(control, None, rejoin.request)
    (image / restore_result.FILE).unlink(missing_ok=True)  # of an earlier start
    sys.stderr.write(f"starts from its periodic image {image}\n")
    sys.stderr.flush()
    _become(
        restore_result.command(
            sys.executable, image, criu=Path(options.criu), remove=False, timeout=options.timeout
        )
    )


def _become(words: Sequence[str]) -> NoReturn:
    for number in _PYTHON_S:
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(words[0], list(words))  # noqa: S606 - as the supervisor would start it
    except OSError as error:
        sys.exit(f"{words[0]} cannot be started: {error.strerror}")


#: Signals for which Python has ways of its own, which an execve keeps where it ignores them.
_PYTHON_S: Final = (signal.SIGPIPE, signal.SIGXFSZ, signal.SIGINT)

if __name__ == "__main__":
    main()
