"""Commands on a host, relayed as if they were typed there."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rosrm.errors import LabError
from tests.waiting import PATIENCE, wait_until

PYTHON = [sys.executable, "-ISc"]
#: Prints each signal it receives, and ends on SIGTERM.
TELL = """
import os, signal, sys
def tell(number, frame):
    os.write(1, signal.Signals(number).name.encode() + b'\\n')
    if number == signal.SIGTERM: sys.exit(9)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP):
    signal.signal(number, tell)
print('ready', flush=True)
while True: signal.pause()
"""


def test_exit_codes_and_signals_are_the_commands(lab):
    """The relay ends with the exit code or the fatal signal of the command."""
    for code in (0, 1, 42, 255):
        assert lab.exec("host1", ["sh", "-c", f"exit {code}"], check=False).returncode == code
    for number in (signal.SIGTERM, signal.SIGKILL, signal.SIGSEGV, signal.SIGINT):
        died = lab.exec("host1", ["sh", "-c", f"kill -{int(number)} $$"], check=False)
        assert died.returncode == -number


def test_a_command_that_is_not_there(lab, tmp_path):
    """The error has the exit codes of shells (127, 126), and the host's name."""
    missing = lab.exec("host1", ["no-such-command"], check=False)
    assert (missing.returncode, missing.stderr) == (
        127,
        "rosrm: on host1: no-such-command: no such command\n",
    )
    text = tmp_path / "text"
    text.write_text("no program")
    assert lab.exec("host1", [str(text)], check=False).returncode == 126
    with pytest.raises(LabError, match="no-such-command on host1: exit code 127"):
        lab.exec("host1", ["no-such-command"])


def test_standard_input_reaches_the_command(lab):
    """The command receives all input and its end of file."""
    assert lab.exec("host1", ["wc", "-c"], input="x" * 100_000).stdout.strip() == "100000"


def test_the_directory_is_the_callers(lab, tmp_path, monkeypatch):
    """The command runs in the caller's directory if the host has it, else on the host's disk."""
    monkeypatch.chdir(tmp_path)
    assert lab.exec("host1", ["pwd"]).stdout.strip() == str(tmp_path)
    there = lab.popen("host1", ["pwd"], cwd="/run/rosrm-lab", stdout=subprocess.PIPE)
    assert there.communicate()[0] == b"/run/data\n"


def test_signals_are_passed_on(lab):
    """Each signal arrives once, and the command decides its meaning."""
    process = lab.popen("host1", [*PYTHON, TELL], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    for number in (signal.SIGUSR1, signal.SIGINT, signal.SIGHUP):
        process.send_signal(number)
        assert process.stdout.readline().decode().strip() == number.name
    process.terminate()
    assert process.communicate(timeout=PATIENCE)[0] == b"SIGTERM\n"
    assert process.returncode == 9


def test_killing_the_relay_kills_the_command(lab):
    """`kill()` of the process from `popen` also kills the command on the host."""
    process = lab.popen("host1", [*PYTHON, TELL], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    (inner,) = lab.pids("host1")
    descriptor = os.pidfd_open(inner)
    process.kill()
    assert select.select([descriptor], [], [], PATIENCE)[0], "the command lives on"
    os.close(descriptor)
    process.communicate()


def test_a_command_that_takes_too_long_is_killed(lab):
    """A timeout kills the command and all its processes."""
    with pytest.raises(subprocess.TimeoutExpired):
        lab.exec("host1", ["sleep", "1000"], timeout=1.0)
    wait_until(lambda: not lab.pids("host1"), "the end of the command")


@pytest.fixture
def terminal(lab):
    """Yield a function that runs `rosrm lab exec` in a terminal, whose output a test can await."""
    opened = []

    def run(*words):
        pid, master = pty.fork()
        if pid == 0:
            os.execv(
                Path(sys.executable).parent / "rosrm",
                ["rosrm", "lab", "exec", "--lab", lab.name, "host1", *words],
            )
        opened.append((pid, master))
        return pid, master

    yield run
    for pid, master in opened:
        os.close(master)
        with contextlib.suppress(ChildProcessError, ProcessLookupError):  # already waited for
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def _read_until(master, wanted):
    said, deadline = b"", time.monotonic() + PATIENCE
    while wanted not in said:
        left = deadline - time.monotonic()
        assert left > 0, f"{wanted!r} was not said, but {said!r}"
        if select.select([master], [], [], left)[0]:
            try:
                said += os.read(master, 4096)
            except OSError:
                pytest.fail(f"it ended before it said {wanted!r}: {said!r}")
    return said


def test_ctrl_c_reaches_the_command_once(terminal):
    """The terminal sends SIGINT to relay and command, so the relay must not send it again."""
    pid, master = terminal(sys.executable, "-ISc", TELL)
    _read_until(master, b"ready")
    os.write(master, b"\x03")
    said = _read_until(master, b"SIGINT")
    os.kill(pid, signal.SIGUSR1)
    said += _read_until(master, b"SIGUSR1")
    assert said.count(b"SIGINT") == 1
    os.kill(pid, signal.SIGTERM)
    _read_until(master, b"SIGTERM")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 9


def test_a_shell_on_a_host_has_a_terminal(terminal):
    """Job control works: Ctrl-C ends the foreground command, not the shell."""
    pid, master = terminal("bash", "--norc", "-i")
    os.write(master, b"tty -s && echo on-$(hostname)-with-a-tty\n")
    _read_until(master, b"on-host1-with-a-tty\r\n")
    os.write(master, b"sleep 1000\n")
    _read_until(master, b"sleep 1000\r\n")
    time.sleep(0.5)  # the shell hands over the terminal; no event signals this
    os.write(master, b"\x03")
    os.write(master, b"echo still-$((40 + 2))\n")
    _read_until(master, b"still-42")
    os.write(master, b"exit 3\n")
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 3
