"""Command line as a whole: version, help, speed, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

from rosrm.cli import groups
from rosrm.cli.command_tree import app, keep_only
from rosrm.version import PROTOCOL_VERSION, __version__


def run(code, *, check=True):
    words = [sys.executable, "-c", code]
    return subprocess.run(words, capture_output=True, text=True, check=check)


def test_version_and_help(rosrm):
    assert rosrm("--version").out == f"rosrm {__version__} (protocol {PROTOCOL_VERSION})\n"
    out = rosrm("--help").out
    for command in ("master", "slave", "submit", "status", "ps", "logs", "explain", "config"):
        assert f"\n  {command} " in out


@pytest.mark.parametrize(
    ("verb", "hint"),
    [
        ("statsu", "Did you mean 'status' or 'restart'?"),
        ("stop", "Did you mean 'cancel' or 'restart'?"),
        ("kill", "Did you mean 'cancel'?"),
        ("ls", "Did you mean 'ps'?"),
        ("nodes", "Did you mean 'hosts'?"),
        ("Create", "Did you mean 'submit'?"),
        ("check", "Did you mean 'config check'?"),
    ],
)
def test_a_verb_of_another_tool_names_the_command_that_does_as_much(rosrm, verb, hint):
    result = rosrm(verb, "talker")
    assert result.code == 2
    assert result.err.splitlines()[-1] == f"Error: No such command '{verb}'. {hint}"


def test_a_destination_without_its_option_names_the_option(rosrm):
    result = rosrm("migrate", "talker", "beta")
    assert result.code == 2
    said = result.err.splitlines()[-1]
    assert "(beta)" in said
    assert said.endswith("The destination is an option: --to HOST")


def commands():
    """Yield every command, with the arguments that select it."""
    group = typer.main.get_command(app)
    for name in group.list_commands(None):
        one = group.get_command(None, name)
        yield (name,), one
        for below, command in getattr(one, "commands", {}).items():
            yield (name, below), command


def test_every_hint_names_a_command_that_exists():
    known = {" ".join(words) for words, _ in commands()}
    assert {verb for verbs in groups._ELSEWHERE.values() for verb in verbs} <= known


@pytest.mark.parametrize("words", [words for words, _ in commands()], ids=" ".join)
def test_a_usage_line_shows_required_arguments_without_braces(rosrm, words):
    assert not set("{}") & set(rosrm(*words, "--help").out.splitlines()[0])


@pytest.mark.parametrize("group", [(), ("lab",), ("criu",), ("config",)], ids=str)
def test_the_help_of_a_group_cuts_no_summary_off(rosrm, group):
    listed = rosrm(*group, "--help").out.partition("Commands:")[2]
    assert listed
    assert "..." not in listed


def test_help_imports_neither_ros_nor_pydantic_nor_numpy():
    """`rosrm --help` is quick because no command imports at once what it needs when it runs."""
    code = (
        "import sys; from rosrm.cli.command_tree import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: print(*sorted("
        "{'rclpy', 'pydantic', 'yaml', 'numpy', 'rosrm.ros.master_connection', 'rosrm_lab.lab'}"
        " & set(sys.modules)))"
    )
    assert run(code).stdout.splitlines()[-1] == ""


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
    done = run(code, check=False)
    assert (done.returncode, done.stderr) == (130, "")


def test_ctrl_c_in_a_running_command_is_clean(tmp_path):
    code = (
        "import rosrm.cli.connection as c, time, sys\n"
        "def connect(settings, _security):\n"
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
    out, err = child.communicate(timeout=60)
    assert (child.returncode, out, err) == (130, "", "")


@pytest.mark.parametrize("ros", [False, True])
@pytest.mark.parametrize("command", ["show", "write"])
@pytest.mark.parametrize("output", ["closed pipe", "full disk", "closed", "file limit"])
def test_output_that_cannot_be_written_gives_no_traceback(command, output, ros, tmp_path):
    """Exit with 1, in silence for a closed pipe; `write` leaves its output to the exit."""
    code = (
        "import sys, types\n"
        "from rosrm.cli import command_tree\n"
        "from rosrm.cli.output import tables\n"
        "@command_tree.app.command()\n"
        "def show(): tables.show('some')\n"
        "@command_tree.app.command()\n"
        "def write(): sys.stdout.write('some')\n"
        f"if {ros}: sys.modules['rclpy'] = types.ModuleType('rclpy')\n"
        f"sys.argv = ['rosrm', {command!r}]\n"
        "from rosrm.cli.app import main\n"
        "main()\n"
    )
    words = [sys.executable, "-c", code]
    if output == "closed":
        words = ["sh", "-c", 'exec "$0" "$@" >&-', *words]
    if output == "file limit":
        words = ["sh", "-c", f'ulimit -f 0; exec "$0" "$@" >{tmp_path}/output', *words]
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as pipe, Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            words, stdout=full if output == "full disk" else pipe, stderr=subprocess.PIPE,
            text=True, check=False, env={**os.environ, "PYTHONUNBUFFERED": ""},
        )  # fmt: skip
    lines = done.stderr.splitlines()
    assert done.returncode == (0 if output == "closed" else 1), lines
    assert len(lines) == (output in ("full disk", "file limit")), lines
    said = "File too large" if output == "file limit" else "No space left on device"
    assert all(said in line for line in lines)


ASKING = """
import sys
from rosrm.cli import connection
from rosrm.model.rows import LogPart
from tests.unit.cli.conftest import FakeClient
client = FakeClient()
client.read_log = lambda host, name, number, offset, *more, **rest: LogPart(
    1, (1,), b"" if offset else b"hello", offset, 5, True, ())
connection.connect = lambda *_: client
sys.argv = ["rosrm", *sys.argv[1:]]
from rosrm.cli.app import main
main()
"""


@pytest.mark.parametrize(
    ("words", "closed", "code"),
    [
        ("ps", ">&-", 0), ("logs talker", ">&-", 0), ("top -n1", ">&-", 0),
        ("ps --host x", "2>&-", 1), ("logs talker", "<&- >&- 2>&-", 0),
    ],
)  # fmt: skip
def test_a_command_whose_standard_streams_are_closed_ends_without_a_traceback(words, closed, code):
    """Output for a closed stream is lost; the exit code does not change."""
    command = [sys.executable, "-c", ASKING, *words.split(), "--domain", "0"]
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" "$@" {closed}', *command], capture_output=True, text=True,
        check=False, cwd=Path(__file__).parents[3], timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def test_no_file_takes_the_number_of_a_closed_standard_stream():
    """Output of a library to standard output is dropped, and not written into that file."""
    code = (
        "import os, sys\n"
        "from rosrm.cli import command_tree\n"
        "@command_tree.app.command()\n"
        "def show():\n"
        "    file = os.open(os.devnull, os.O_RDONLY)\n"
        "    assert file > 2\n"
        "    assert all(os.get_inheritable(stream) for stream in range(3))\n"
        "sys.argv = ['rosrm', 'show']\n"
        "from rosrm.cli.app import main\n"
        "main()\n"
    )
    words = ["sh", "-c", 'exec "$0" "$@" <&- >&-', sys.executable, "-c", code]
    done = subprocess.run(words, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("command", "usage"),
    [
        ("submit", "Usage: rosrm submit [OPTIONS] WORK...\n"),
        ("cancel", "Usage: rosrm cancel [OPTIONS] [NAME|WORK...]\n"),
        ("prune", "Usage: rosrm prune [OPTIONS] [NAME...]\n"),
    ],
)
def test_a_usage_line_says_once_that_a_word_may_be_repeated(rosrm, command, usage):
    assert rosrm(command, "--help").out.startswith(usage)


@pytest.mark.parametrize(
    ("words", "kept"), [(["ps", "--all"], ["ps"]), (["config", "check"], None), ([], None)]
)
def test_only_the_named_command_is_built(monkeypatch, words, kept):
    """The types of the parameters of all commands cost 40 ms."""
    all_of_them = list(app.registered_commands)
    monkeypatch.setattr(app, "registered_commands", all_of_them.copy())
    monkeypatch.setattr(app, "registered_groups", [*app.registered_groups])
    keep_only(words)
    names = [one.callback.__name__ for one in app.registered_commands]
    assert names == (kept or [one.callback.__name__ for one in all_of_them])
    assert bool(app.registered_groups) == (kept is None)
