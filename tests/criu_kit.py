"""CRIU for tests, and processes that are dumped and restored; none of them outlives its test.

The CRIU is the one that rosrm itself finds: what `make setup` installed (tests/conftest.py), or
what `ROSRM_CRIU` names. Where it does not work tests are skipped, with why.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import dump, process_tree, restore_result
from rosrm_criu.engine.binary import CriuBinary, find
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.probe import CriuSupport, probe
from rosrm_criu.engine.restore_result import Outcome

#: Seconds for whatever a busy machine needs; nothing waits so long when all goes well.
TIMEOUT = 60.0

#: What a host tells of itself and its CRIU (`rosrm_criu.engine.compatibility.FACTS`).
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
    """The CRIU that works here, or why there is none."""
    try:
        criu = find()
    except CriuError as error:
        return None, str(error)
    tried: CriuSupport = probe(criu, timeout=TIMEOUT)
    return (criu, "") if tried.works else (None, tried.reason)


@pytest.fixture
def criu() -> CriuBinary:
    """The CRIU that works here; the test is skipped where there is none."""
    working, reason = _found()
    if working is None:
        pytest.skip(f"no CRIU that works here: {reason}")
    return working


@pytest.fixture
def theatre(criu, tmp_path):
    """Starts, dumps and restores processes for one test."""
    made = Theatre(criu, tmp_path)
    yield made
    made.close()


class Theatre:
    """Starts processes as the supervisor does, dumps and restores them.

    Args:
        criu: that works.
        folder: of the test.
    """

    def __init__(self, criu: CriuBinary, folder: Path):
        self.criu, self.folder = criu, folder
        self.work = folder / "work"
        self.work.mkdir()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._restored: list[int] = []

    def start(self, code: str, *arguments: str, **options: Any) -> Actor:
        """A Python program without site-packages."""
        return self.run([sys.executable, "-I", "-S", "-c", code, *arguments], **options)

    def run(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        pass_fds: Sequence[int] = (),
    ) -> Actor:
        """A session leader whose output is a file of its own."""
        log = self.folder / f"{len(self._processes)}.log"
        with log.open("ab") as output:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                cwd=self.work if self.work.exists() else self.folder, start_new_session=True,
                pass_fds=pass_fds, env=os.environ if environment is None else environment,
            )  # fmt: skip
        self._processes.append(process)
        return Actor(process, log)

    def dump(self, actor: Actor, name: str = "image", leave: dump.Leave = "killed") -> Path:
        """The directory of its image."""
        directory = self.folder / name
        self.manifest: Manifest = dump.dump(
            self.criu, actor.pid, directory, leave=leave, timeout=TIMEOUT, process="actor",
            instance=1,
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
        """The program that restores an image, just started."""
        command = [*self.shim_command(directory, remove=remove), *options]
        return self.run(command, environment=environment)

    def shim_command(
        self, directory: Path, *, remove: bool = False, then: Sequence[str] = ()
    ) -> tuple[str, ...]:
        """Its command line."""
        program = Path(self.criu.command[0])
        return restore_result.command(
            sys.executable, directory, criu=program, remove=remove, timeout=TIMEOUT, then=then
        )

    def restore(self, directory: Path, *options: str, **named: Any) -> Actor:
        """The program that holds a restored process."""
        actor = self.shim(directory, *options, **named)
        actor.outcome = restore_result.wait(
            directory, timeout=TIMEOUT, ended=lambda: actor.process.poll() is not None
        )
        self._restored.append(os.pidfd_open(actor.outcome.pid))
        return actor

    def close(self) -> None:
        """End them all."""
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
    """A process, and what it wrote.

    Args:
        process: or the program that holds it.
        log: its standard output and error.
    """

    outcome: Outcome

    def __init__(self, process: subprocess.Popen[bytes], log: Path):
        self.process, self.log = process, log
        self.pid = process.pid

    def lines(self) -> list[str]:
        """The whole lines that it wrote so far."""
        return [line for line in self.log.read_text().splitlines(True) if line.endswith("\n")]

    def numbers(self) -> list[int]:
        """Those among its lines that are numbers."""
        return [int(line) for line in self.lines() if line.strip().isdigit()]

    def says(self, line: str) -> None:
        """Wait for a line."""
        eventually(lambda: f"{line}\n" in self.lines(), f"a line {line!r} in {self.log.name}")

    def counts(self) -> int:
        """Wait until it has written two numbers more; returns the last."""
        seen = len(self.numbers())
        eventually(lambda: len(self.numbers()) > seen + 1, f"numbers in {self.log.name}")
        return self.numbers()[-1]


def eventually(condition: Callable[[], object], what: str) -> None:
    """Wait for something that nothing tells of."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"waited {TIMEOUT} s for {what}")
        time.sleep(0.01)
