"""Lookup of the supervisor of a state directory, or its start."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import SupervisorError
from rosrm.runtime import oom_score, private_files
from rosrm.supervisor import endpoint
from rosrm.supervisor.logs import LogLimits
from rosrm.wording import reason_of

_CHUNK: Final = 1 << 16


def connect_or_start(state: Path, start: bool, log: LogLimits, deadline: float) -> socket.socket:
    """Return a connection to the supervisor of a state directory.

    Raises:
        TimeoutError: a supervisor exists, and accepts no connection in time.
        SupervisorError: there is none and none can be started in time.
    """
    while True:
        try:
            return endpoint.connect(str(state), deadline - clocks.boot_time())
        except TimeoutError:
            raise
        except (FileNotFoundError, ConnectionRefusedError):
            if not start:
                raise SupervisorError(f"no supervisor serves {state}") from None
        except OSError as error:
            raise SupervisorError(f"{state} cannot be used: {reason_of(error)}") from None
        problem = _start(state, log, deadline)
        if not problem:
            continue
        if clocks.boot_time() > deadline or endpoint.ANOTHER not in problem:
            raise SupervisorError(f"the supervisor of {state} did not start: {problem}")
        # Another supervisor is about to listen or to end: neither can be awaited from here.
        time.sleep(0.02)


def _start(state: Path, log: LogLimits, deadline: float) -> str:
    """Start a supervisor and wait for its first line; return "" if ready, else the error."""
    main = Path(__file__).with_name("__main__.py")
    names = (
        "--log-max-bytes", "--log-keep", "--log-instances", "--log-processes", "--log-keep-bytes"
    )  # fmt: skip
    limits = [f"{name}={value}" for name, value in zip(names, log, strict=True)]
    command = [sys.executable, "-I", "-S", str(main), "--state", str(state), *limits]
    try:
        with oom_score.score_of_children():  # it protects itself
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                umask=private_files.user_umask(),  # its processes inherit it
            )
    except OSError as error:  # most likely where the former one has ended for lack of memory
        return f"its process cannot be started: {reason_of(error)}"
    assert process.stdout is not None
    with process.stdout as output:
        answer = b""
        while not answer.startswith(b"ready\n"):
            if not readable(output, max(0.0, deadline - clocks.boot_time())):
                answer += b"it was not ready in time"
                process.kill()  # the first stage; it may hang, e.g. on a disk that does not answer
                break
            part = os.read(output.fileno(), _CHUNK)
            if not part:
                break
            answer += part
    process.wait()
    if answer == b"ready\n":
        return ""
    return answer.decode(errors="replace").strip() or "it wrote no reason"


def readable(file: socket.socket | object, timeout: float | None) -> bool:
    """Return True if there is something to read within `timeout` seconds; None: no limit.

    A file that another thread has closed counts as readable: the read reports it.
    """
    return _poll(file, select.POLLIN, timeout)


def writable(file: socket.socket, timeout: float | None) -> bool:
    """Return True if there is room to write within `timeout` seconds; None: no limit."""
    return _poll(file, select.POLLOUT, timeout)


def _poll(file: object, event: int, timeout: float | None) -> bool:
    poll = select.poll()
    try:
        poll.register(file, event)  # type: ignore[arg-type]
    except ValueError:  # closed
        return True
    return bool(poll.poll(None if timeout is None else timeout * 1000.0))
