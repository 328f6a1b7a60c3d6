"""The CRIU program: search and execution.

Search order: the environment variable `ROSRM_CRIU` (a path), the private prefix that
`scripts/install_criu.sh` fills, and PATH.
"""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.runtime.log_tail import last_lines
from rosrm.runtime.signalling import send_to_group
from rosrm.shortage import exists
from rosrm.supervisor.spawn import find_executable
from rosrm.supervisor.spawn_error import SpawnError, is_transient
from rosrm.wording import ending_of, reason_of
from rosrm_criu.engine.criu_log import causes, first_words

#: Environment variable with the path of the program; if it is set, nothing else is searched.
PROGRAM_VARIABLE: Final = "ROSRM_CRIU"
#: Environment variable with the path of the private prefix.
PREFIX_VARIABLE: Final = "ROSRM_CRIU_PREFIX"
#: Path of the program below a prefix.
PROGRAM: Final = "bin/criu"
#: Oldest usable version; older ones cannot dump an internet socket, which every ROS node has.
OLDEST: Final = (4, 2)

#: Seconds for `criu --version`.
_ANSWER: Final = 10.0
#: Seconds between two looks for the end of a child without a pidfd.
_LOOK: Final = 0.01
_CAP_SYS_ADMIN: Final = 21  # linux/capability.h
#: Folders that Debian uses for CRIU and that an ordinary user's PATH lacks.
_PLACES: Final = "/usr/local/sbin:/usr/sbin:/sbin"


class CriuUnknownError(CriuError):
    """No look at CRIU is possible now, which does not tell that it is absent or does not work."""


@dataclass(frozen=True)
class CriuBinary:
    """A CRIU that starts; `rosrm_criu.engine.probe` tests its capability on this host.

    Args:
        command: the program, and the words that precede every argument.
        version: as CRIU reports it, e.g. "4.2.1".
    """

    command: tuple[str, ...]
    version: str

    @property
    def number(self) -> tuple[int, ...]:
        """Return the version as a tuple of numbers, for comparisons."""
        return numbers_in(self.version)

    def run(
        self,
        arguments: Sequence[str],
        *,
        timeout: float,
        log: Path,
        pass_fds: Sequence[int] = (),
    ) -> None:
        """Run CRIU and wait for its end; without CAP_SYS_ADMIN, pass `--unprivileged`.

        CRIU runs in a session of its own, so that a Ctrl-C for this process does not interrupt a
        dump. A process whose dump is interrupted continues to run. If CRIU was to kill it after the
        dump, it may already be dead.

        Args:
            arguments: the first one is the CRIU command: `dump`, `restore`, ...
            timeout: seconds; then CRIU is killed.
            log: CRIU's log file, an absolute path; an existing file is replaced.
            pass_fds: file descriptors that CRIU inherits under the same numbers.

        Raises:
            CriuError: CRIU failed (with the lines of its log that say why), or the timeout passed.
        """
        unprivileged = () if may_do_all() else ("--unprivileged",)
        log.unlink(missing_ok=True)  # otherwise its errors would be reported as the cause
        words = [*self.command, *arguments, *unprivileged, "--log-file", str(log)]
        with tempfile.TemporaryFile("w+", errors="replace") as printed:
            try:
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=printed,
                    pass_fds=pass_fds,
                    start_new_session=True,
                )
            except OSError as error:
                raise CriuError(f"CRIU cannot be started: {words[0]}: {reason_of(error)}") from None
            code = _end_of(process, timeout)
            printed.seek(0)
            output = printed.read()
        if code == 0:
            return
        what = f"CRIU {self.version} could not {arguments[0]}"
        if code is None:
            why = f"it was not done after {timeout:g} s and was ended"
        else:
            why = _why(log, output) or f"{ending_of(code)}, without a reason"
        raise CriuError(f"{what}: {why} (its log: {log})")


def find(prefix: Path | None = None) -> CriuBinary:
    """Return the CRIU to use on this host.

    Args:
        prefix: the private prefix, instead of the default one.

    Raises:
        CriuError: none starts; the message names the places searched, and what to do.
        CriuUnknownError: one may start, but cannot be tried now.
    """
    named = os.environ.get(PROGRAM_VARIABLE, "")
    if named:
        try:
            return opened(Path(named))
        except CriuError as error:
            raise type(error)(
                f"{PROGRAM_VARIABLE} names a CRIU that cannot be used: {error}"
            ) from None
    private = (default_prefix() if prefix is None else prefix) / PROGRAM
    broken = []
    for look in (partial(_at, private), _in_path):
        try:
            if (place := look()) is not None:
                return opened(place)
        except CriuUnknownError:
            raise
        except OSError as error:
            raise CriuUnknownError(f"CRIU cannot be looked for now: {reason_of(error)}") from None
        except CriuError as error:
            broken.append(str(error))
    looked = f"looked for: {PROGRAM_VARIABLE} (not set), {private}, `criu` in PATH"
    raise CriuError("; ".join([*broken, f"there is no CRIU here ({looked})"]) + f". {REMEDY}")


def _at(place: Path) -> Path | None:
    return place if exists(place) else None


def _in_path() -> Path | None:
    path = f"{os.environ.get('PATH', '')}:{_PLACES}"
    try:
        return Path(find_executable("criu", {"PATH": path}))
    except SpawnError as error:
        if error.transient:
            raise CriuUnknownError(f"CRIU cannot be looked for now: {error}") from None
        return None


#: Remedy in error messages if there is no CRIU.
REMEDY: Final = "`scripts/install_criu.sh` of rosrm's repository installs one in a folder"


def opened(program: Path) -> CriuBinary:
    """Return a program as a `CriuBinary`.

    Raises:
        CriuError: it does not answer like CRIU.
        CriuUnknownError: it cannot be started now, or does not answer in time.
    """
    try:
        answer = subprocess.run(
            [program, "--version"],
            capture_output=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
            timeout=_ANSWER,
            check=False,
        )
    except OSError as error:
        why = reason_of(error)
        if isinstance(error, FileNotFoundError) and exists(program):
            why = "the C library that it names is missing; if CRIU was moved, install it again"
        kind = CriuUnknownError if is_transient(error) else CriuError
        raise kind(f"{program} cannot be started: {why}") from None
    except subprocess.TimeoutExpired:
        raise CriuUnknownError(f"{program} --version did not answer within {_ANSWER:g} s") from None
    version = re.search(r"^Version:\s*v?(\d+(?:\.\d+)+)", answer.stdout, re.MULTILINE)
    if answer.returncode != 0 or version is None:
        line = (answer.stderr.strip() or answer.stdout.strip() or "nothing").splitlines()[-1]
        raise CriuError(
            f"{program} is not a working CRIU: `--version` printed {line!r} "
            f"({ending_of(answer.returncode)})"
        )
    return CriuBinary((str(program),), version[1])


def numbers_in(version: str) -> tuple[int, ...]:
    """Return a version as a tuple of numbers, for comparisons."""
    return tuple(map(int, re.findall(r"\d+", version)))


def may_do_all() -> bool:
    """Return True if this process has CAP_SYS_ADMIN: root does, but not in every container."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    effective = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    return effective is not None and bool(int(effective[1], 16) >> _CAP_SYS_ADMIN & 1)


def default_prefix() -> Path:
    """Return the prefix of `install_criu.sh`: PREFIX_VARIABLE, or the user's data directory."""
    named = os.environ.get(PREFIX_VARIABLE, "")
    if named:
        return Path(named).absolute()
    data = os.environ.get("XDG_DATA_HOME", "")
    below = Path(data) if data.startswith("/") else Path.home() / ".local/share"
    return below / "rosrm/criu"


def _end_of(process: subprocess.Popen[bytes], timeout: float) -> int | None:
    """Return the exit code; None: the timeout passed, and the process group was killed."""
    has_ended = False
    try:
        has_ended = _wait_for_end(process.pid, timeout)
    finally:
        if not has_ended:  # also if this wait is interrupted: the process would never be reaped
            send_to_group(process.pid, signal.SIGKILL)
        code = process.wait()
    return code if has_ended else None


def _wait_for_end(pid: int, timeout: float) -> bool:
    """Wait for the end of a child; return True if it ended within `timeout` seconds.

    A pidfd reports the end at once. `Popen.wait` with a timeout polls and returns up to 0.05 s
    late, and the node is frozen for that time.
    """
    try:
        descriptor = os.pidfd_open(pid)
    except OSError:  # a filter of system calls refuses it
        until = clocks.awake_time() + timeout
        wanted = os.WEXITED | os.WNOWAIT | os.WNOHANG
        while (ended := os.waitid(os.P_PID, pid, wanted)) is None and clocks.awake_time() < until:
            time.sleep(_LOOK)
        return ended is not None
    try:
        end = select.poll()
        end.register(descriptor, select.POLLIN)
        return bool(end.poll(timeout * 1000.0))
    finally:
        os.close(descriptor)


def _why(log: Path, output: str) -> str:
    """Return the cause of a failure from the log, or from earlier output if there is no log."""
    written = "\n".join(last_lines(log))
    return "; ".join(causes(written) or causes(output) or first_words(output))
