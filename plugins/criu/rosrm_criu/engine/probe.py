"""Can CRIU move a process here? Tried, not asked: `criu check` says yes where it is no.

    python -m rosrm_criu.engine.probe      one line of JSON: works, reason, facts

A child with a bound UDP socket and a counter in its memory is dumped and restored; then its counter
has to go on and its socket has to answer. This takes a few tenths of a second and leaves nothing
behind, also where this process is killed: a shell waits for its end and clears up.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm_criu.engine.binary import OLDEST, REMEDY, Criu, find
from rosrm_criu.engine.compatibility_facts import INTERPRETER, facts_of

#: Seconds for all of it; it takes a few tenths.
TIMEOUT: Final = 20.0
#: A word in what CRIU says where it has no rights; its error messages are no interface, but this
#: one names the interface.
_NO_RIGHT: Final = "CAP_CHECKPOINT_RESTORE"
_YAMA: Final = Path("/proc/sys/kernel/yama/ptrace_scope")

#: The child. It tells the clearer of itself, so that it is not missed; then it counts what it is
#: sent, and ends by itself where it is sent nothing for long.
_SUBJECT: Final = """
import os, socket, sys
clearer = int(sys.argv[3])
os.write(clearer, b"%d\\n" % os.getpid())
os.close(clearer)
count = 0
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
    ours.bind(("127.0.0.1", 0))
    ours.settimeout(float(sys.argv[2]))
    asker = ("127.0.0.1", int(sys.argv[1]))
    while True:
        ours.sendto(b"%d" % count, asker)
        ours.recv(1)
        count += 1
"""
#: Makes the folder. Then it reads the child's pid, and nothing when that is gone. At the end of its
#: input, which comes when neither the probe nor a CRIU of it lives any more, it removes all.
_CLEARER: Final = """
trap "" PIPE
mkdir -m 700 -- "$0" || exit
echo made
while read -r word; do pid=$word; done
if [ -n "$pid" ]; then kill -9 "$pid"; fi
rm -rf -- "$0"
"""


@dataclass(frozen=True)
class Ability:
    """What CRIU can do here.

    Args:
        works: a process was dumped and restored.
        reason: why not, and what to do about it; "" where it works.
        facts: see `rosrm_criu.engine.compatibility`; empty where there is no CRIU.
    """

    works: bool
    reason: str
    facts: Mapping[str, str]


def ability(prefix: Path | None = None) -> Ability:
    """Find the CRIU to use here and try it."""
    try:
        return probe(find(prefix))
    except CriuError as error:
        return Ability(False, str(error), {})


def probe(criu: Criu, *, timeout: float = TIMEOUT) -> Ability:
    """Try a CRIU by a dump and a restore.

    Args:
        criu: the one to try.
        timeout: seconds for all of it.
    """
    reason = ""
    try:
        _exercise(criu, time.monotonic() + timeout)
    except CriuError as error:
        reason = _with_remedy(criu, str(error))
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = f"CRIU could not be tried: {error}"
    return Ability(not reason, reason, facts_of(criu))


def setcap_command(criu: Criu) -> str:
    """What gives an ordinary user's CRIU the rights that it needs."""
    capabilities = "cap_checkpoint_restore,cap_setpcap"
    with contextlib.suppress(OSError, ValueError):
        if int(_YAMA.read_text(encoding="ascii")) > 0:  # only parents may look into a process
            capabilities += ",cap_sys_ptrace"
    return f"sudo setcap {capabilities}+eip {os.path.realpath(criu.command[-1])}"


def _with_remedy(criu: Criu, reason: str) -> str:
    """A reason, and what to do where that is known."""
    if criu.number < OLDEST:
        least = ".".join(map(str, OLDEST))
        return f"CRIU {criu.version} is too old, {least} is needed: {REMEDY} (tried: {reason})"
    if _NO_RIGHT in reason and os.geteuid() == 0:
        return (
            f"CRIU {criu.version} has no right to dump and restore: root lacks CAP_SYS_ADMIN and "
            "CAP_CHECKPOINT_RESTORE here. A container is given the latter when it is made "
            "(`--cap-add CHECKPOINT_RESTORE`)"
        )
    if _NO_RIGHT in reason:
        return (
            f"CRIU {criu.version} has no right to dump and restore as an ordinary user. "
            f"`{setcap_command(criu)}` gives it; or run the slave as root"
        )
    return reason


# --- the trial --------------------------------------------------------------------------------


def _exercise(criu: Criu, until: float) -> None:
    """Dump and restore a child; raises `CriuError` at what does not work."""
    with (
        _folder() as (folder, clearer),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
    ):
        ours.bind(("127.0.0.1", 0))
        trial = _Trial(criu, until, folder, clearer)
        with _subject(ours.getsockname()[1], trial) as process:
            address = _heard(ours, trial, "0", "started")
            _ask(ours, address, trial, "1", "started")
            trial.run("dump", "--tree", str(process.pid))
            process.wait(max(1.0, trial.left))  # a zombie would still have the pid
            # A sibling of CRIU is a child of ours: we can wait for its end.
            trial.run("restore", "--restore-detached", "--restore-sibling")
            _ask(ours, address, trial, "2", "was restored")


@dataclass(frozen=True)
class _Trial:
    criu: Criu
    until: float
    folder: Path
    clearer: int

    @property
    def left(self) -> float:
        """Seconds."""
        return self.until - time.monotonic()

    def run(self, *arguments: str) -> None:
        """Let CRIU do something; raises `CriuError`."""
        log = self.folder / f"{arguments[0]}.log"
        words = (*arguments, "--images-dir", str(self.folder))
        try:
            self.criu.run(words, timeout=max(0.1, self.left), log=log, pass_fds=(self.clearer,))
        except CriuError as error:
            # The log is removed with all else.
            raise CriuError(str(error).replace(f" (its log: {log})", "")) from None


def _ask(
    ours: socket.socket, address: tuple[str, int], trial: _Trial, count: str, after: str
) -> None:
    """Have the child count on; raises `CriuError` where it does not."""
    ours.sendto(b"?", address)
    _heard(ours, trial, count, after)


def _heard(ours: socket.socket, trial: _Trial, count: str, after: str) -> tuple[str, int]:
    """Where the child's count came from; raises `CriuError` if another one came, or none."""
    ours.settimeout(max(0.1, trial.left))
    try:
        said, address = ours.recvfrom(16)
    except TimeoutError:
        raise CriuError(f"a child that {after} does not answer over UDP on loopback") from None
    if said.decode("ascii", "replace") != count:
        raise CriuError(f"a child that {after} counts {said!r}, not {count}")
    return str(address[0]), int(address[1])


@contextlib.contextmanager
def _subject(port: int, trial: _Trial) -> Iterator[subprocess.Popen[bytes]]:
    """The child, and what it is restored as, for a time."""
    words = (str(port), f"{max(1.0, trial.left):.0f}", str(trial.clearer))
    process = subprocess.Popen(
        [INTERPRETER, "-I", "-S", "-c", _SUBJECT, *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=(trial.clearer,),
        start_new_session=True,
        cwd="/",
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        # Restored, it is another child of ours with the same pid.
        with contextlib.suppress(ChildProcessError):
            if os.waitpid(process.pid, os.WNOHANG)[0] == 0:
                os.kill(process.pid, signal.SIGKILL)
                os.waitpid(process.pid, 0)
        os.write(trial.clearer, b"\n")


@contextlib.contextmanager
def _folder() -> Iterator[tuple[Path, int]]:
    """A folder, and the pipe to the shell that removes it when all who hold the pipe are gone."""
    folder = Path(tempfile.gettempdir(), f"rosrm-criu-{uuid.uuid4().hex}")
    with subprocess.Popen(
        ["/bin/sh", "-c", _CLEARER, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        cwd="/",
    ) as clearer:
        assert clearer.stdin is not None
        assert clearer.stdout is not None
        if not clearer.stdout.readline():
            raise OSError(f"no folder can be made in {folder.parent}")
        yield folder, clearer.stdin.fileno()
        # Leaving closes the pipe and waits for the shell.


def main() -> int:
    """Say what CRIU can do here, for a program that started this one."""
    print(json.dumps(asdict(ability())), flush=True)  # noqa: T201 - that is what it is for
    return 0


if __name__ == "__main__":
    sys.exit(main())
