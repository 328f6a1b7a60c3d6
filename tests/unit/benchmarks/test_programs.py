"""Start and end of the benchmarks: missing programs, errors and signals."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import stopping
from benchmarks.chaos import __main__ as chaos
from benchmarks.chaos import clocks
from rosrm.errors import LabError
from rosrm.keys.key_files import key_home, make_secret
from rosrm_lab import needs

ROOT = Path(__file__).resolve().parents[3]
#: Programs that a benchmark starts and ends.
CHILDREN = {"simulated_slaves", "criu_desk", "handoff_nodes"}

#: Benchmark that receives a signal in the middle.
SIGNALLED = """
import contextlib, os, signal, sys
from benchmarks.stopping import run

def main():
    with contextlib.ExitStack() as opened:
        opened.callback(print, "cleaned up", flush=True)
        try:
            os.kill(os.getpid(), int(sys.argv[1]))
        except Exception:
            print("swallowed", flush=True)

sys.exit(run("it", main))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_benchmark_after_its_clean_ups(number):
    """Clean-ups run, and no `except Exception` on the way hides the signal."""
    ended = subprocess.run(
        [sys.executable, "-c", SIGNALLED, str(int(number))],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.stdout == "cleaned up\n"
    assert ended.stderr == f"benchmarks.it: stopped by {signal.Signals(number).name}\n"
    assert ended.returncode == 128 + number


@pytest.mark.parametrize("error", [LabError("no loop devices"), OSError("no loop devices")])
def test_what_is_missing_is_one_sentence(monkeypatch, capsys, error):
    def main():
        raise error

    monkeypatch.setattr(stopping, "raise_signals", lambda: None)
    assert stopping.run("it", main) == 2
    assert capsys.readouterr().err == "benchmarks.it: no loop devices\n"


def test_a_benchmark_uses_keys_of_its_own(monkeypatch):
    """The user's keys stay untouched, and are used again afterwards."""
    monkeypatch.setenv("ROSRM_KEY", "/home/ada/ada.key")
    monkeypatch.setenv("ROSRM_KEYS", "/home/ada")
    used = {}

    def main():
        used.update(os.environ)
        make_secret(key_home())

    monkeypatch.setattr(stopping, "raise_signals", lambda: None)
    assert stopping.run("it", main) == 0
    assert "ROSRM_KEY" not in used
    assert not Path(used["ROSRM_KEYS"]).exists()
    assert (os.environ["ROSRM_KEY"], os.environ["ROSRM_KEYS"]) == ("/home/ada/ada.key", "/home/ada")


PROGRAMS = sorted(
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if "__main__" in path.read_text() and path.stem not in CHILDREN
)


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_benchmark_is_ended_so(program):
    text = (ROOT / f"benchmarks/{program}.py").read_text()
    assert re.search(rf'^    sys\.exit\(run\("{program}", main\)\)$', text, re.MULTILINE)


@pytest.mark.parametrize("program", needs.COMMANDS)
def test_chaos_names_a_missing_program_before_it_begins(monkeypatch, tmp_path, program):
    """`nft` is checked too, though only the first network fault needs it."""
    found = shutil.which("true")
    monkeypatch.setattr(needs, "check_rights", lambda: None)
    monkeypatch.setattr(shutil, "which", lambda name, **_: None if name == program else found)
    out = tmp_path / "out"
    with pytest.raises(LabError, match=f"the command '{program}' is missing.*apt-get install"):
        chaos.main(["--out", str(out)])
    assert not out.exists()


def test_a_clock_is_given_to_a_part_and_not_to_what_enters_its_host(monkeypatch, tmp_path):
    """Without libfaketime the command does not change."""
    monkeypatch.setattr(clocks, "library", lambda: Path("/lib/faketime.so"))
    command = clocks.with_clock(tmp_path, "master", ["rosrm", "master"])
    assert (command[0], command[-2:]) == ("env", ["rosrm", "master"])
    assert "LD_PRELOAD=/lib/faketime.so" in command
    monkeypatch.setattr(clocks, "library", lambda: None)
    assert clocks.with_clock(tmp_path, "master", ["rosrm", "master"]) == ["rosrm", "master"]
