"""Completion of values in bash and zsh: names from the master, and silence without one."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from rosrm.cli import completion, early
from rosrm.cli.command_tree import app
from rosrm.client import connecting
from rosrm.errors import ConfigError, NoMaster


@pytest.fixture
def complete(client, monkeypatch):
    """Return a function that completes a command line, with a fake master."""
    client.settings = []
    monkeypatch.setattr(client, "close", lambda: None)
    monkeypatch.setattr(type(client), "__enter__", lambda self: self, raising=False)
    monkeypatch.setattr(type(client), "__exit__", lambda *_: None, raising=False)
    monkeypatch.setattr(completion, "_silence_errors", lambda: None)

    def connect(settings, **_):
        client.settings.append(settings)
        return client

    monkeypatch.setattr(connecting, "connect", connect)

    def run(*words, shell="bash"):
        line = " ".join(("rosrm", *words))
        environment = {
            "_ROSRM_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": line,
            "COMP_WORDS": line, "COMP_CWORD": str(len(words)),
        }  # fmt: skip
        done = CliRunner(env=environment).invoke(app, [], prog_name="rosrm")
        assert done.exit_code == 0
        return re.findall(r"[\w-]+", re.sub("^(_arguments|_files)", "", done.stdout))

    return run


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("explain", ""), ["talker", "next", "crashed", "done"]),
        (("restart", "talker", "n"), ["next"]),
        (("cancel", "t"), ["talker"]),
        (("logs", "cr"), ["crashed"]),
        (("events", "--process", "d"), ["done"]),
        (("migrate", "talker", "--to", "b"), ["beta"]),
        (("drain", ""), ["alpha", "beta", "gamma"]),
        (("ps", "--host", "g"), ["gamma"]),
        (("prune", "--host", "g"), ["gamma"]),
        (("explain", "zzz"), []),
    ],
)
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_names_of_the_master_complete(complete, words, names, shell):
    """Each argument completes with what it names."""
    assert complete(*words, shell=shell) == names


@pytest.mark.parametrize(
    "words", [("--domain", "7", "explain", ""), ("explain", "--domain", "7", "")]
)
def test_the_domain_of_the_command_line_is_used(complete, client, words):
    """The option counts before and after the command."""
    assert complete(*words)
    assert client.settings[-1].domain == 7


@pytest.mark.parametrize("fault", [NoMaster("none"), ConfigError("bad key"), RuntimeError("bug")])
def test_a_fault_completes_nothing(complete, client, fault):
    """Neither a silent master nor a wrong key appears in the command line."""
    client.fails = fault
    assert complete("explain", "") == []


def test_a_master_that_does_not_answer_is_given_up(complete, client, monkeypatch):
    """The wait for the answer ends after the limit."""
    clock = [0.0]
    passes = lambda: clock.append(clock[-1] + 0.2) or clock[-1]  # noqa: E731
    monkeypatch.setattr("rosrm.clocks.boot_time", passes)
    client.waits = (0.1, 0.2, 0.3, 0.4)
    assert complete("explain", "") == []


@pytest.mark.parametrize("variable", ["COMP_WORDS", "_TYPER_COMPLETE_ARGS"])
def test_the_search_begins_before_the_command_line_is_read(variable):
    """The command that is completed joins ROS as early as the command itself."""
    shell = {"_ROSRM_COMPLETE": "complete_it", variable: "rosrm explain t"}
    assert early.completed_words(shell) == ["explain", "t"]
    assert early.completed_words({variable: "rosrm explain t"}) == []


def test_without_a_master_nothing_is_printed(tmp_path):
    """A real search in an empty domain ends within seconds, without a word."""
    environment = {
        **os.environ, "_ROSRM_COMPLETE": "complete_bash", "COMP_WORDS": "rosrm explain ",
        "COMP_CWORD": "2", "ROS_DOMAIN_ID": "201", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROSRM_KEYS": str(tmp_path), "ROSRM_SECURITY": "none",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "rosrm.cli"], env=environment, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert (done.stdout.strip(), done.stderr, done.returncode) == ("", "", 0)
