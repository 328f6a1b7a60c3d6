"""Ends of processes in which a plugin has left what never ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

LEFT_BEHIND = {
    "a thread": "threading.Thread(target=time.sleep, args=(1000,)).start()",
    "a pool": "concurrent.futures.ThreadPoolExecutor(1).submit(time.sleep, 1000)",
    "a worker": (
        "multiprocessing.get_context('fork').Process(target=time.sleep, args=(1000,)).start()"
    ),
    "a handler at exit": "atexit.register(time.sleep, 1000)",
}


@pytest.mark.parametrize("left", LEFT_BEHIND.values(), ids=LEFT_BEHIND)
def test_a_part_ends_although_a_plugin_has_left_something(left: str) -> None:
    """The process ends with its exit code within seconds, and leaves no worker behind."""
    program = (
        "import atexit, concurrent.futures, multiprocessing, threading, time\n"
        f"from rosrm.runtime.process_end import end_process\n{left}\nend_process(7)"
    )
    process = subprocess.run([sys.executable, "-c", program], timeout=60.0, check=False)
    assert process.returncode == 7


def test_a_part_whose_terminal_was_closed_ends_with_its_code() -> None:
    """The last output of the process cannot be written any more."""
    terminal, its_end = os.openpty()
    program = (
        "import sys; from rosrm.runtime.process_end import end_process\n"
        "print('ready'); sys.stdin.read(); sys.stdout.write('last words'); end_process(7)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=its_end, stderr=its_end,
        env={**os.environ, "PYTHONUNBUFFERED": ""},
    )  # fmt: skip
    os.close(its_end)
    assert b"ready" in os.read(terminal, 100)
    os.close(terminal)
    process.communicate(b"continue\n", timeout=60.0)
    assert process.returncode == 7


#: Commands that import the plugins, and their exit codes.
COMMANDS = {"plugins --local": 0, "config check work.yaml": 0, "master --config invalid.yaml": 2}


@pytest.mark.parametrize(("words", "code"), COMMANDS.items())
def test_a_command_ends_although_a_plugin_has_left_a_thread(
    tmp_path: Path, imported: Callable[[str], None], words: str, code: int
) -> None:
    """Otherwise a service manager would take a master with invalid settings for one that runs."""
    imported(f"import threading, time\n{LEFT_BEHIND['a thread']}\n")
    (tmp_path / "work.yaml").write_text("processes: [{name: p, command: sleep 1}]\n")
    (tmp_path / "invalid.yaml").write_text("scoring: {policy: nosuch}\n")
    command = [sys.executable, "-m", "rosrm.cli", *words.split()]
    ended = subprocess.run(command, cwd=tmp_path, timeout=60.0, check=False)
    assert ended.returncode == code
