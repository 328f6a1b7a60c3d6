"""Functional test of CRIU on this host; `criu check` also succeeds where dumps fail.

    python -m rosrm_criu.engine.probe      one line of JSON: works, reason, facts

The test dumps and restores a child with a bound UDP socket and a counter in its memory. Then the
counter must continue, and the socket must answer. This takes a few tenths of a second. Nothing is
left behind, even if this process is killed, because a shell waits for its end and cleans up.
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
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.runtime.signalling import send
from rosrm_criu.engine.binary import OLDEST, REMEDY, CriuBinary, find
from rosrm_criu.engine.compatibility import INTERPRETER, facts_of

#: Seconds for the whole test, which normally takes a few tenths.
TIMEOUT: Final = 20.0
#: Seconds for the cleaner to remove everything.
_CLEARED: Final = 2.0
#: Part of CRIU's error message if it lacks rights. The messages are no stable interface, but this
#: word is the name of a capability.
_NO_RIGHT: Final = "CAP_CHECKPOINT_RESTORE"
_YAMA: Final = Path("/proc/sys/kernel/yama/ptrace_scope")

#: Program of the child. It reports its pid to the cleaner, so that the cleaner can kill it. Then it
#: counts the datagrams that it receives, and ends after a long time without one.
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
#: Program of the cleaner: creates the folder and reads the child's pid (an empty line: the child
#: has ended). Its input ends when neither the probe nor its CRIU lives; then it removes everything.
_CLEARER: Final = """
trap "" PIPE
mkdir -m 700 -- "$0" || exit
echo made
while read -r word; do pid=$word; done
if [ -n "$pid" ]; then kill -9 "$pid"; fi
rm -rf -- "$0"
"""


@dataclass(frozen=True)
class CriuSupport:
    """The capability of CRIU on this host.

    Args:
        works: a process was dumped and restored.
        reason: the obstacle and its remedy; "": CRIU works.
        facts: see `rosrm_criu.engine.compatibility`; empty if there is no CRIU.
    """

    works: bool
    reason: str
    facts: Mapping[str, str]


def criu_support(prefix: Path | None = None) -> CriuSupport:
    """Find the CRIU to use on this host and test it."""
    try:
        return probe(find(prefix))
    except CriuError as error:
        return CriuSupport(False, str(error), {})


def probe(criu: CriuBinary, *, timeout: float = TIMEOUT) -> CriuSupport:
    """Test a CRIU by a dump and a restore.

    Args:
        criu: the CRIU to test.
        timeout: seconds for the whole test.
    """
    reason = ""
    try:
        _exercise(criu, clocks.boot_time() + timeout)
    except CriuError as error:
        reason = _with_remedy(criu, str(error))
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = f"CRIU could not be tried: {error}"
    return CriuSupport(not reason, reason, facts_of(criu))


def setcap_command(criu: CriuBinary) -> str:
    """Return the command that gives an ordinary user's CRIU the capabilities that it needs."""
    capabilities = "cap_checkpoint_restore,cap_setpcap"
    with contextlib.suppress(OSError, ValueError):
        if int(_YAMA.read_text(encoding="ascii")) > 0:  # only a parent may ptrace a process
            capabilities += ",cap_sys_ptrace"
    return f"sudo setcap {capabilities}+eip {os.path.realpath(criu.command[-1])}"


def _with_remedy(criu: CriuBinary, reason: str) -> str:
    """Return the reason with its remedy, if one is known."""
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


def _exercise(criu: CriuBinary, until: float) -> None:
    """Dump and restore a child; raise `CriuError` at the first step that fails."""
    with (
        _folder() as (folder, clearer),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
    ):
        ours.bind(("127.0.0.1", 0))
        trial = _Trial(criu, until, folder, clearer)
        with _subject(ours.getsockname()[1], trial) as process:
            address = _receive(ours, trial, "0", "started")
            _ask(ours, address, trial, "1", "started")
            trial.run("dump", "--tree", str(process.pid))
            process.wait(max(1.0, trial.left))  # otherwise the zombie would still hold the pid
            # --restore-sibling makes the process a child of this one, which can then reap it.
            trial.run("restore", "--restore-detached", "--restore-sibling")
            _ask(ours, address, trial, "2", "was restored")


@dataclass(frozen=True)
class _Trial:
    criu: CriuBinary
    until: float
    folder: Path
    clearer: int

    @property
    def left(self) -> float:
        """Return the seconds that are left."""
        return self.until - clocks.boot_time()

    def run(self, *arguments: str) -> None:
        """Run a CRIU command; raise `CriuError`."""
        log = self.folder / f"{arguments[0]}.log"
        words = (*arguments, "--images-dir", str(self.folder))
        try:
            self.criu.run(words, timeout=max(0.1, self.left), log=log, pass_fds=(self.clearer,))
        except CriuError as error:
            # The log is removed together with the folder.
            raise CriuError(str(error).replace(f" (its log: {log})", "")) from None


def _ask(
    ours: socket.socket, address: tuple[str, int], trial: _Trial, count: str, after: str
) -> None:
    """Make the child count one step further; raise `CriuError` if it does not."""
    ours.sendto(b"?", address)
    _receive(ours, trial, count, after)


def _receive(ours: socket.socket, trial: _Trial, count: str, after: str) -> tuple[str, int]:
    """Return the sender of the expected count; raise `CriuError` for another count or none."""
    ours.settimeout(max(0.1, trial.left))
    try:
        answer, address = ours.recvfrom(16)
    except TimeoutError:
        raise CriuError(f"a child that {after} does not answer over UDP on loopback") from None
    if answer.decode("ascii", "replace") != count:
        raise CriuError(f"a child that {after} counts {answer!r}, not {count}")
    return str(address[0]), int(address[1])


@contextlib.contextmanager
def _subject(port: int, trial: _Trial) -> Iterator[subprocess.Popen[bytes]]:
    """Start the child; at the end, kill it or the process that it was restored as."""
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
        # After the restore it is a new child of this process, with the same pid.
        with contextlib.suppress(ChildProcessError):
            if os.waitpid(process.pid, os.WNOHANG)[0] == 0:
                send(process.pid, signal.SIGKILL)
                os.waitpid(process.pid, 0)
        os.write(trial.clearer, b"\n")


@contextlib.contextmanager
def _folder() -> Iterator[tuple[Path, int]]:
    """Yield a folder, and the pipe of the cleaner, which removes it once all ends are closed."""
    folder = Path(tempfile.gettempdir(), f"rosrm-criu-{uuid.uuid4().hex}")
    clearer = subprocess.Popen(
        ["/bin/sh", "-c", _CLEARER, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        cwd="/",
    )
    assert clearer.stdin is not None
    assert clearer.stdout is not None
    with clearer.stdin, clearer.stdout:
        if not clearer.stdout.readline():
            raise OSError(f"no folder can be made in {folder.parent}")
        yield folder, clearer.stdin.fileno()
    # A process that a killed CRIU has left may hold the pipe: the cleaner then waits for its end.
    with contextlib.suppress(subprocess.TimeoutExpired):
        clearer.wait(_CLEARED)


def main() -> int:
    """Print the result of the test as JSON, for the program that started this one."""
    print(json.dumps(asdict(criu_support())), flush=True)  # noqa: T201 - that is what it is for
    return 0


if __name__ == "__main__":
    sys.exit(main())
