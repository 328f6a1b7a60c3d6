"""Setting `ros.interface`: participants of rosrm use one network interface alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "programs" / "two_interfaces.py"


@pytest.mark.parametrize(
    ("first", "second", "seconds", "answer"),
    [
        ("left", "left", 30, "discovered"),
        ("left", "10.1.0.1", 30, "discovered"),
        ("left", "right", 2, "not discovered"),
    ],
)
def test_participants_discover_each_other_over_the_chosen_interface_alone(
    first, second, seconds, answer
):
    """The interface is given by its name or its address; both interfaces allow multicast."""
    done = subprocess.run(
        [sys.executable, PROGRAM, first, second, str(seconds)],
        capture_output=True, text=True, check=True, timeout=90,
    )  # fmt: skip
    if done.stdout == "not permitted\n":
        pytest.skip("a private network needs CAP_SYS_ADMIN and CAP_NET_ADMIN")
    assert done.stdout == f"{answer}\n", done.stderr
