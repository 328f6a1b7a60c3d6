"""CRIU for tests, and processes that tests dump and restore; no process outlives its test.

rosrm's own search finds CRIU: that of `make setup` (tests/conftest.py), or that of `ROSRM_CRIU`.
Where CRIU does not work, tests are skipped with the reason.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import dump, page_server, process_tree, restore_result
from rosrm_criu.engine.binary import CriuBinary, find
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.memory_copy import MemoryCopy
from rosrm_criu.engine.probe import CriuSupport, probe
from rosrm_criu.engine.restore_result import Outcome
from tests.waiting import wait_until

#: Seconds allowed on a busy machine; no wait takes so long unless a test fails.
TIMEOUT = 60.0
#: Wait for a state without an event: `eventually(condition, what)`.
eventually = functools.partial(wait_until, timeout=TIMEOUT)

#: Facts of a host and its CRIU (`rosrm_criu.engine.compatibility.FACTS`).
HOST_FACTS = {
    "version": "4.2.1",
    "kernel": "6.18.44",
    "machine": "x86_64",
    "cpu": "avx avx2 sse2",
    "uid": "1000",
    "all_users": "no",
    "python": "/usr/bin/python3.12",
    "python_version": "3.12.3",
    "libc": "glibc 2.39",
}


@functools.cache
def _found() -> tuple[CriuBinary | None, str]:
    """Return the CRIU that works here, or the reason why there is none."""
    try:
        criu = find()
    except CriuError as error:
        return None, str(error)
    tried: CriuSupport = probe(criu, timeout=TIMEOUT)
    return (criu, "") if tried.works else (None, tried.reason)


@pytest.fixture
def criu() -> CriuBinary:
    """Return the CRIU that works here; skip the test where there is none."""
    working, reason = _found()
    if working is None:
        pytest.skip(f"no CRIU that works here: {reason}")
    return working


@pytest.fixture
def theatre(criu, tmp_path):
    """Yield what starts, dumps and restores processes for one test."""
    made = Theatre(criu, tmp_path)
    yield made
    made.close()


class Theatre:
    """Start of processes as by the supervisor, their dumps and restores.

    Args:
        criu: a CRIU that works.
        folder: the folder of the test.
    """

    def __init__(self, criu: CriuBinary, folder: Path):
        self.criu, self.folder = criu, folder
        self.work = folder / "work"
        self.work.mkdir()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._restored: list[int] = []

    def start(self, code: str, *arguments: str, **options: Any) -> Actor:
        """Start a Python program without site-packages."""
        return self.run([sys.executable, "-I", "-S", "-c", code, *arguments], **options)

    def run(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        pass_fds: Sequence[int] = (),
    ) -> Actor:
        """Start a session leader that writes its output into its own file."""
        log = self.folder / f"{len(self._processes)}.log"
        with log.open("ab") as output:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                cwd=self.work if self.work.exists() else self.folder, start_new_session=True,
                pass_fds=pass_fds, env=os.environ if environment is None else environment,
            )  # fmt: skip
        self._processes.append(process)
        return Actor(process, log)

    def dump(
        self,
        actor: Actor,
        name: str = "image",
        leave: dump.Leave = "killed",
        copy: MemoryCopy | None = None,
    ) -> Path:
        """Dump a process; return the directory of the image."""
        directory = self.folder / name
        self.manifest: Manifest = dump.dump(
            self.criu, actor.pid, directory, leave=leave, timeout=TIMEOUT, process="actor",
            instance=1, checksums=copy is None,
            receive=copy and functools.partial(page_server.serve, copy=copy),
        )  # fmt: skip
        if leave == "killed":
            actor.process.wait(TIMEOUT)
        return directory

    def shim(
        self,
        directory: Path,
        *options: str,
        remove: bool = False,
        environment: Mapping[str, str] | None = None,
    ) -> Actor:
        """Start the shim that restores an image."""
        command = [*self.shim_command(directory, remove=remove), *options]
        return self.run(command, environment=environment)

    def shim_command(
        self, directory: Path, *, remove: bool = False, then: Sequence[str] = ()
    ) -> tuple[str, ...]:
        """Return the command line of the shim."""
        program = Path(self.criu.command[0])
        return restore_result.command(
            sys.executable, directory, criu=program, remove=remove, timeout=TIMEOUT, then=then
        )

    def restore(self, directory: Path, *options: str, **named: Any) -> Actor:
        """Restore an image; return the shim once the process is restored."""
        actor = self.shim(directory, *options, **named)
        actor.outcome = restore_result.wait(
            directory, timeout=TIMEOUT, ended=lambda: actor.process.poll() is not None
        )
        self._restored.append(os.pidfd_open(actor.outcome.pid))
        return actor

    def close(self) -> None:
        """End all processes."""
        for process in self._processes:
            if process.poll() is None:
                members = process_tree.tree(process.pid)
                process_tree.send(members, signal.SIGKILL)
                process.wait(TIMEOUT)
        for pidfd in self._restored:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            os.close(pidfd)


class Actor:
    """Process with its output.

    Args:
        process: the process, or the shim of a restored one.
        log: file with standard output and error.
    """

    outcome: Outcome

    def __init__(self, process: subprocess.Popen[bytes], log: Path):
        self.process, self.log = process, log
        self.pid = process.pid

    def lines(self) -> list[str]:
        """Return the complete lines of output so far."""
        return [line for line in self.log.read_text().splitlines(True) if line.endswith("\n")]

    def numbers(self) -> list[int]:
        """Return the numbers among the lines."""
        return [int(line) for line in self.lines() if line.strip().isdigit()]

    def says(self, line: str) -> None:
        """Wait until the process has written a line."""
        eventually(lambda: f"{line}\n" in self.lines(), f"a line {line!r} in {self.log.name}")

    def counts(self) -> int:
        """Wait until the process has written two more numbers; return the last."""
        seen = len(self.numbers())
        eventually(lambda: len(self.numbers()) > seen + 1, f"numbers in {self.log.name}")
        return self.numbers()[-1]
