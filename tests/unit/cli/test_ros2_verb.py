"""`ros2 rosrm`: the verb as `ros2` calls it, and with the real `ros2` where it can be imported."""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest

from rosrm.cli import app
from rosrm.cli.ros2_verb import RosrmVerb
from rosrm.version import __version__

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[3]
REAL = """
import sys
from ros2cli.cli import main
sys.exit(main(argv=sys.argv[1:]))
"""


@pytest.fixture
def words(monkeypatch):
    """Return a function that gives words to `ros2`, and returns those that reach `rosrm`."""
    reached = []
    monkeypatch.setattr(app, "main", reached.append)

    def call(*given):
        extension = RosrmVerb()
        parser = argparse.ArgumentParser(prog="ros2")
        parser.add_argument("--use-python-default-buffering", action="store_true")
        verbs = parser.add_subparsers(dest="verb")
        extension.add_arguments(verbs.add_parser(RosrmVerb.NAME), "ros2 rosrm")
        extension.main(parser=parser, args=parser.parse_args(["rosrm", *given]))
        return reached.pop()

    return call


@pytest.mark.parametrize(
    "given",
    [
        (), ("-h",), ("--help",), ("ps", "--help"), ("--domain", "7", "ps", "--json"),
        ("run", "--name", "a", "--", "sleep", "-1"), ("launch", "a", "x.py", "y:=--z"),
        ("ps", ""),
    ],
)  # fmt: skip
def test_every_word_reaches_rosrm(words, given):
    """Options, `--` and empty words are for `rosrm`, not for `ros2`."""
    assert words(*given) == list(given)


def test_ros2_can_call_the_verb_without_a_base_class():
    """The entry point names a class with the attributes of ros2cli's own commands."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    kind = resolve_name(project["entry-points"]["ros2cli.command"]["rosrm"])
    assert (kind.NAME, kind.EXTENSION_POINT_VERSION) == ("rosrm", "0.1")
    assert kind.__doc__  # `ros2 -h` shows its first line
    assert "ros2cli" not in sys.modules


@pytest.fixture
def completer(monkeypatch):
    """Return the function by which argcomplete completes the words after `ros2 rosrm`."""
    monkeypatch.setattr("rosrm.cli.ros2_verb._PATIENCE", 60.0)  # a busy machine needs some seconds
    parser = argparse.ArgumentParser()
    RosrmVerb().add_arguments(parser, "ros2")
    (action,) = (one for one in parser._actions if one.dest == "words")

    def call(*words):
        *before, prefix = words
        given = argparse.Namespace(words=list(before))
        return action.completer(prefix=prefix, action=action, parser=parser, parsed_args=given)

    return call


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (("ad",), ["adopt"]),
        (("ps", "--all", "--ho"), ["--host"]),
        (("key", "rev"), ["revoke"]),
        (("ps", "--zzz"), []),
        (("run", "it's", "--time"), ["--time-limit"]),
    ],
)
def test_words_after_ros2_rosrm_complete(completer, given, found):
    """`ros2` completes by argcomplete, which gets the words that `rosrm` offers a shell."""
    assert completer(*given) == found


def test_before_the_first_word_all_commands_are_offered(completer):
    """Argcomplete has parsed no word then."""
    assert {"adopt", "ps", "up"} <= set(completer(""))


@pytest.mark.skipif(
    importlib.util.find_spec("ros2cli") is None, reason="this machine has no ros2cli"
)
@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        (["-h"], 0, "Place the processes"),
        (["rosrm", "--version"], 0, f"rosrm {__version__}"),
        (["rosrm", "-h"], 0, "Usage: rosrm"),
        (["rosrm", "config", "check", "none.yaml"], 2, "none.yaml"),
    ],
)
def test_the_real_ros2_runs_the_verb(given, code, said):
    """The output and exit code are those of `rosrm`."""
    done = subprocess.run(
        [sys.executable, "-c", REAL, *given],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == code
    assert said in done.stdout + done.stderr
