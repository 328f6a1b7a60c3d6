"""Completeness of the last answer of a transfer end that is stopped at the same time."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.ros.clusters import PATIENCE, wait_until


def test_a_fetch_ended_while_it_reports_its_error_reports_it() -> None:
    """A fetch that gets SIGTERM while it writes its error completes the error, and only that."""
    heard, said = os.pipe()
    with subprocess.Popen(
        [sys.executable, "-m", "rosrm_criu.transfer", "fetch"],
        stdin=subprocess.PIPE, stdout=said, stderr=subprocess.PIPE,
    ) as fetch, os.fdopen(heard) as answers:  # fmt: skip
        assert fetch.stdin is not None
        assert fetch.stderr is not None
        fetch.stdin.write(b'{"introduce": true}\n')
        fetch.stdin.flush()
        assert "certificate" in json.loads(answers.readline())
        filled = fill(said)
        os.close(said)
        fetch.stdin.close()  # so the error is: stopped before it began
        waits_in = Path(f"/proc/{fetch.pid}/wchan")
        wait_until(lambda: "pipe_write" in waits_in.read_text(), "it is about to tell")
        fetch.send_signal(signal.SIGTERM)
        told = answers.read()[filled:]
        assert fetch.wait(PATIENCE) == 1
        assert json.loads(told) == {"error": "the fetch was stopped before it began"}
        assert fetch.stderr.read() == b""


def fill(pipe: int) -> int:
    """Fill a pipe completely; return the number of bytes."""
    # A new open file description, so that O_NONBLOCK does not apply to the other writer.
    another, filled = os.open(f"/proc/self/fd/{pipe}", os.O_WRONLY | os.O_NONBLOCK), 0
    with contextlib.suppress(BlockingIOError):
        while True:
            filled += os.write(another, b" " * 4096)
    os.close(another)
    return filled
