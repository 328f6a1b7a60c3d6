"""Protection from the OOM killer: of the supervisor, and not of its processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rosrm
from rosrm.runtime.oom_score import PROTECTED

SCORE = Path("/proc/self/oom_score_adj")
#: Protects itself with a given score; prints its own score, that of a child, and the reason.
AGENT = f"""
import subprocess, sys
from rosrm.runtime import oom_score
oom_score.PROTECTED = int(sys.argv[1])
reason = oom_score.protect()
read = ["cat", "{SCORE}"]
with oom_score.score_of_children():
    child = subprocess.run(read, stdout=subprocess.PIPE, text=True).stdout
own = open("{SCORE}").read()
print(own.strip(), child.strip(), reason, sep="|")
"""


def agent(before: int, protected: int) -> list[str]:
    """Run an agent that is started with a score; return its score, a child's, and the reason."""
    command = [sys.executable, "-c", AGENT, str(protected)]
    said = subprocess.run(
        ["sh", "-c", f'echo {before} > {SCORE}; exec "$@"', "sh", *command],
        stdout=subprocess.PIPE, text=True, check=True, timeout=30,
        env={**os.environ, "PYTHONPATH": str(Path(rosrm.__file__).parent.parent)},
    )  # fmt: skip
    return said.stdout.strip().split("|")


def may_lower() -> bool:
    """Return True if this process may lower its score."""
    lower = f"echo {PROTECTED} > {SCORE}"
    return subprocess.run(["sh", "-c", lower], check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize(("before", "child"), [(600, "600"), (300, "0"), (200, "0")])
def test_an_agent_is_protected_and_its_children_are_not(before: int, child: str) -> None:
    """They have the score with which the agent was started, unless that was a protected one."""
    assert agent(before, protected=300) == [str(min(before, 300)), child, ""]


@pytest.mark.skipif(may_lower(), reason="has CAP_SYS_RESOURCE")
def test_an_agent_without_rights_says_why_it_is_not_protected() -> None:
    """Its children have its own score, as without protection."""
    reason = f"{SCORE} cannot be lowered: Permission denied"
    assert agent(0, PROTECTED) == ["0", "0", reason]


@pytest.mark.skipif(not may_lower(), reason="needs CAP_SYS_RESOURCE")
def test_the_supervisor_is_protected_and_its_processes_are_not(host, client) -> None:
    """Whatever a process leaks, it is killed before the supervisor that restarts it."""
    pid = host.sleeper(client, "leak")
    assert Path(f"/proc/{client.pid}/oom_score_adj").read_text() == f"{PROTECTED}\n"
    assert Path(f"/proc/{pid}/oom_score_adj").read_text() == SCORE.read_text()
