"""The command itself: version, help, speed, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from rosrm.version import PROTOCOL_VERSION, __version__


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_version_and_help(rosrm):
    assert rosrm("--version").out == f"rosrm {__version__} (protocol {PROTOCOL_VERSION})\n"
    out = rosrm("--help").out
    for command in ("master", "slave", "submit", "status", "ps", "logs", "explain", "config"):
        assert f"\n  {command} " in out


def test_a_mistyped_command_is_refused(rosrm):
    result = rosrm("statsu")
    assert result.code == 2
    assert "No such command 'statsu'" in result.err


def test_help_imports_neither_ros_nor_pydantic_nor_numpy():
    """This is what makes `rosrm --help` quick."""
    code = (
        "import sys, rosrm.cli.commands;"
        "print(*sorted({'rclpy', 'pydantic', 'yaml', 'numpy', 'rosrm.ros.client'}"
        " & set(sys.modules)))"
    )
    assert run(code).stdout.strip() == ""


def test_ctrl_c_before_a_command_has_begun_is_clean():
    code = (
        "import sys\n"
        "class Stop:\n"
        "    def find_spec(self, name, *more):\n"
        "        if name == 'typer': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Stop())\n"
        "from rosrm.cli.app import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "")


def test_ctrl_c_in_a_running_command_is_clean(tmp_path):
    code = (
        "import rosrm.cli.connection as c, time, sys\n"
        "def connect(settings):\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(30)\n"
        "c.connect = connect\n"
        "sys.argv = ['rosrm', 'ps']\n"
        "from rosrm.cli.app import main\n"
        "main()\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "ready\n"
    time.sleep(0.05)
    os.kill(child.pid, signal.SIGINT)
    out, err = child.communicate(timeout=10)
    assert (child.returncode, out, err) == (130, "", "")
