"""Timer slack of the parts, and of the processes that a supervisor starts."""

from __future__ import annotations

import subprocess
import sys

_SLACK = "open('/proc/self/timerslack_ns').read().strip()"


def test_a_child_of_an_exact_process_gets_the_usual_slack_back() -> None:
    """Otherwise the processes of users would wake the machine more often."""
    child = f"from rosrm.runtime import timer_slack as t; t.use_usual_timers(); print({_SLACK})"
    program = (
        "import subprocess, sys; from rosrm.runtime import timer_slack as t\n"
        f"t.use_exact_timers(); print({_SLACK}, flush=True)\n"
        f"subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert ended.stdout.split() == ["1", "50000"]
