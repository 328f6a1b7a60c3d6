"""Demo runs as a user starts them, with a check that nothing is left behind."""

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
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

MARK = "ROSRM_TEST_OF_THE_DEMO"
SHARED_MEMORY = re.compile(r"/dev/shm/\S+")


class Run:
    """A running demo, whose processes all carry a mark in their environment.

    Args:
        module: module of the demo.
        out: output folder.
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
        """Return the pids of all living processes of the run, including the demo."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    if self.mark in (entry / "environ").read_bytes().split(b"\0"):
                        found.append(int(entry.name))
                except OSError:  # it has ended since
                    continue
        return found

    def look(self) -> None:
        """Record the shared memory that the processes of the run have mapped."""
        for pid in self.processes():
            try:
                self.shared.update(SHARED_MEMORY.findall(Path(f"/proc/{pid}/maps").read_text()))
            except OSError:
                continue

    def wait_for(self, what: str, seconds: float = 90.0) -> None:
        """Wait until a line of the progress contains `what`."""
        assert self.demo.stdout is not None
        deadline = time.monotonic() + seconds
        for line in self.demo.stdout:
            if what in line:
                return
            assert time.monotonic() < deadline, f"{what!r} did not come in time"
        pytest.fail(f"the demo ended before {what!r}: {self.demo.communicate()[1]}")

    def end(self, seconds: float) -> tuple[int, str, str]:
        """Wait for the end; return exit status, standard output and standard error."""
        deadline = time.monotonic() + seconds
        while self.demo.poll() is None and time.monotonic() < deadline:
            self.look()
            with suppress(subprocess.TimeoutExpired):
                self.demo.wait(1.0)
        has_ended = self.demo.poll() is not None
        if not has_ended:
            self.kill()
        output, errors = self.demo.communicate(timeout=20.0)
        assert has_ended, f"the demo did not end in {seconds:g} s: {output}{errors}"
        return self.demo.returncode, output, errors

    def check_clean(self) -> None:
        """Check that no process and no shared memory is left."""
        assert self.processes() == []
        left = [path for path in sorted(self.shared) if self.left(Path(path))]
        assert not left, f"left in shared memory: {left}; {self.killed()}"

    def killed(self) -> str:
        """Return a text with the instances that were killed, which leave their shared memory."""
        found = {}
        for record in self.out.glob("cluster/hosts/*/supervisor/instances.jsonl"):
            for line in record.read_text().splitlines():
                state = json.loads(line)
                if "SIGKILL" in state.get("message", ""):
                    found["{}#{}".format(*state["key"])] = state["message"]
        return f"killed: {found}"

    def left(self, path: Path) -> bool:
        """Return True if a file belongs to this run only and is newer than the demo.

        ROS tracing and the port mutexes keep their files on purpose. All DDS participants of the
        machine share the ports from 7000 on, in every domain.
        """
        if re.match(r"lttng|sem\.fastrtps_port|fastrtps_port70", path.name) or not path.exists():
            return False
        return path.stat().st_ctime > self.began

    def kill(self) -> None:
        """Kill all processes, also those that start during the search for them."""
        while found := self.processes():
            for pid in found:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        self.demo.communicate()


def read_lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@contextmanager
def runs_of(module: str, out: Path) -> Iterator[Callable[..., Run]]:
    """Yield a function that starts a demo; kill its remaining processes at the end."""
    started: list[Run] = []

    def start(*arguments: str) -> Run:
        started.append(Run(module, out, *arguments))
        return started[-1]

    try:
        yield start
    finally:
        for one in started:
            one.kill()
