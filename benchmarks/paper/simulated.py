"""Agreement of `rosrm simulate` with a recorded run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.paper.labs import Failed

_LONGEST = 120.0


def agreement(records: Path) -> dict[str, Any]:
    """Replay and simulate the only record in a folder; return the result of `rosrm simulate`."""
    found = sorted(records.glob("*.rosrec"))
    if len(found) != 1:
        raise Failed(f"one record was expected in {records}, and {len(found)} are there")
    rosrm = Path(sys.executable).with_name("rosrm")
    ended = subprocess.run(
        [rosrm, "simulate", found[0], "--json"], capture_output=True, text=True, timeout=_LONGEST,
        check=False,
    )  # fmt: skip
    if ended.returncode:
        raise Failed(f"rosrm simulate of the run's record failed: {ended.stderr.strip()}")
    report = json.loads(ended.stdout)
    return {
        "replayed_decisions": report["record"]["decisions"],
        "replayed_differently": report["record"]["different"],
        **report["agreement"],
    }
