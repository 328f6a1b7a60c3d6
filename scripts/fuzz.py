"""Run the fuzz tests with random seeds until a time has passed, or one fails: `make fuzz`.

Each round prints its seed. After a failure pytest shows the smallest failing example, and the last
line the command that runs the round again.
"""

from __future__ import annotations

import argparse
import os
import secrets
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Examples of a round, as a multiple of those in `make test`: some minutes on two cores.
TIMES = 5


def main() -> int:
    """Run rounds until the time has passed; return the exit status of the last one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="least time, e.g. 0.5")
    parser.add_argument("--seed", type=int, help="of one single round")
    options = parser.parse_args()
    end = time.monotonic() + 60.0 * options.minutes
    number = 0
    while True:
        number += 1
        seed = options.seed or secrets.randbits(32)
        print(f"=== round {number}, seed {seed} ===", flush=True)
        status = run_round(seed)
        if status:
            print(f"failed; again: {sys.executable} scripts/fuzz.py --seed {seed}", flush=True)
            return status
        if options.seed or time.monotonic() > end:
            print(
                f"{number} rounds of {TIMES} times the examples of `make test` passed", flush=True
            )
            return 0


def run_round(seed: int) -> int:
    """Run each fuzz test with a seed; return the exit status of pytest."""
    command = [
        *(sys.executable, "-m", "pytest", "tests/fuzz", "-q", "-x", "-n", "auto", "--timeout=0"),
        f"--hypothesis-seed={seed}",
    ]
    environment = {**os.environ, "ROSRM_FUZZ_TIMES": str(TIMES)}
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
