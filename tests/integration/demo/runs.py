"""Demos as a user runs them, and proof that they leave nothing behind."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

MARK = "ROSRM_TEST_OF_THE_DEMO"
SHARED_MEMORY = re.compile(r"/dev/shm/\S+")


class Run:
    """A demo that was started; everything that comes of it carries a mark in its environment.

    Args:
        module: of the demo.
        out: folder that it writes to.
    """

    def __init__(self, module: str, out: Path, *arguments: str) -> None:
        self.out = out
        self.mark = f"{MARK}={uuid.uuid4()}".encode()
        name, _, value = self.mark.decode().partition("=")
        self.demo = subprocess.Popen(
            [sys.executable, "-m", f"rosrm_examples.{module}", "--out", str(out), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, name: value},
        )
        self.shared: set[str] = set()
        self.began = time.time()

    def processes(self) -> list[int]:
        """All that live, the demo itself included."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    if self.mark in (entry / "environ").read_bytes().split(b"\0"):
                        found.append(int(entry.name))
                except OSError:  # it has ended meanwhile
                    continue
        return found

    def look(self) -> None:
        """Note the shared memory that our processes have mapped."""
        for pid in self.processes():
            try:
                self.shared.update(SHARED_MEMORY.findall(Path(f"/proc/{pid}/maps").read_text()))
            except OSError:
                continue

    def wait_for(self, what: str, seconds: float = 40.0) -> None:
        """Wait until a line of the progress says something."""
        assert self.demo.stdout is not None
        deadline = time.monotonic() + seconds
        for line in self.demo.stdout:
            if what in line:
                return
            assert time.monotonic() < deadline, f"{what!r} did not come in time"
        pytest.fail(f"the demo ended before {what!r}: {self.demo.communicate()[1]}")

    def end(self, seconds: float) -> tuple[int, str, str]:
        """Wait for its end; exit status, standard output, standard error."""
        deadline = time.monotonic() + seconds
        while self.demo.poll() is None and time.monotonic() < deadline:
            self.look()
            time.sleep(1.0)
        output, errors = self.demo.communicate(timeout=1.0)
        return self.demo.returncode, output, errors

    def check_clean(self) -> None:
        """No process and no shared memory is left."""
        assert self.processes() == []
        assert [path for path in sorted(self.shared) if self.left(Path(path))] == []

    def left(self, path: Path) -> bool:
        """A file of ours alone, and newer than the demo.

        The tracing of ROS and the mutexes of the ports keep theirs on purpose, and the ports from
        7000 on are shared by all DDS participants of the machine, whatever their domain.
        """
        if re.match(r"lttng|sem\.fastrtps_port|fastrtps_port70", path.name) or not path.exists():
            return False
        return path.stat().st_ctime > self.began

    def kill(self) -> None:
        for pid in self.processes():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        self.demo.communicate()


def read_lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@contextmanager
def runs_of(module: str, out: Path) -> Iterator[Callable[..., Run]]:
    """Starts a demo with the arguments given; what is left of it at the end is killed."""
    started: list[Run] = []

    def start(*arguments: str) -> Run:
        started.append(Run(module, out, *arguments))
        return started[-1]

    try:
        yield start
    finally:
        for one in started:
            one.kill()
