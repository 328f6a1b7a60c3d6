"""Program that removes what killed containers have left, and then becomes `podman run`.

    start.py PODMAN run OPTIONS... IMAGE COMMAND...

A container whose `podman run` is gone was killed with it, and podman still lists it. The
interpreter runs with -I -S, so this module imports the standard library only.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

#: Label of the containers of one slave.
LABEL: Final = "rosrm.slave"
#: Variable with the path of the key of the instance, which only the user of the slave can read.
KEY_FILE: Final = "ROSRM_INSTANCE_KEY_FILE"
#: Seconds for podman to list or to remove containers.
_PATIENCE: Final = 30.0


def main(argv: list[str]) -> None:
    """Remove left-over containers of the same slave, and execute the command."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a stop during the start needs no traceback
    program, own = argv[0], Path(_option(argv, "--pidfile="))
    own.unlink(missing_ok=True)  # of an earlier start
    files = [one for one in own.parent.iterdir() if one.suffix in (".pid", ".key")]
    listed = set(_listed(program, _option(argv, "--label=")))
    running = set(_running())  # read last, because another container may start at this moment
    for file in files:
        if file.stem not in running:
            file.unlink(missing_ok=True)
    _copy_key(own.with_suffix(".key"))
    if listed - running:
        _ask(program, "rm", "--force", "--time=0", *(listed - running))
    os.execv(program, argv)  # noqa: S606 - no shell is wanted


def _copy_key(copy: Path) -> None:
    """Copy the key of the instance for the container, which may run as any user.

    Other users of this host cannot enter the directory of the copy. If the slave could not write
    the key, as on a full disk, podman reports the missing file, and the process is started again.
    """
    key = os.environ.get(KEY_FILE, "")
    if key:
        copy.unlink(missing_ok=True)
        with suppress(OSError):
            copy.write_bytes(Path(key).read_bytes())
            copy.chmod(0o444)


def _option(argv: list[str], option: str) -> str:
    return next(word.removeprefix(option) for word in argv if word.startswith(option))


def _listed(program: str, label: str) -> list[str]:
    """Return the names of all containers of a slave."""
    answer = _ask(program, "ps", "--all", f"--filter=label={label}", "--format={{.Names}}")
    return answer.split()


def _running() -> Iterator[str]:
    """Yield the names of containers of which `podman run`, or this program, runs now.

    Raises:
        OSError: a process cannot be looked at; its container is not to be removed for that.
    """
    for pid in filter(str.isdigit, os.listdir("/proc")):  # noqa: PTH208 - of names
        try:
            words = Path("/proc", pid, "cmdline").read_bytes().split(b"\0")
        except (FileNotFoundError, ProcessLookupError, PermissionError):  # ended, or of another
            continue
        names = (word for word in words if word.startswith(b"--name=rosrm-"))
        yield from (os.fsdecode(name.partition(b"=")[2]) for name in names)


def _ask(program: str, *arguments: str) -> str:
    """Return what podman prints; "" if it fails, because the start itself reports why."""
    try:
        answer = subprocess.run(
            [program, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, timeout=_PATIENCE, check=False, text=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return ""
    return answer.stdout


if __name__ == "__main__":
    main(sys.argv[1:])
