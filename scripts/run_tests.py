"""Run the tests folder by folder and close with one table: `make test`.

Each folder under `tests/` is one run of pytest, and only what is independent runs in parallel.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "build" / "test-results"

#: In this order: what fails fast comes first.
LAYERS = ("unit", "contract", "integration", "ros", "faults")

#: Workers of the folders whose tests share nothing but the load of the machine. Where there is a
#: ROS graph, each worker has a network of its own, if it may; the tests of a file share a cluster.
#: The files with the most tests come first, or those that take long (tests/conftest.py).
_BY_FILE = ["-n", "2", "--dist", "loadfile"]
WORKERS = {
    "unit": ["-n", "2"],
    "integration": _BY_FILE,
    "ros": [*_BY_FILE, "--no-loadscope-reorder"],
    "faults": _BY_FILE,
}

# Of pytest's exit statuses:
INTERRUPTED = 2
NO_TESTS = 5


@dataclass(frozen=True)
class Outcome:
    """What became of one folder."""

    layer: str
    status: int
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0


def main() -> int:
    """Run the folders asked for; answer with the exit status of the first pytest that failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layers", nargs="+", choices=LAYERS, default=LAYERS)
    options, for_pytest = parser.parse_known_args()
    # Ctrl-C goes to pytest too, which ends its tests in order: wait for it, then close.
    signal.signal(signal.SIGINT, lambda *_: None)
    outcomes = []
    for layer in options.layers:
        if not (ROOT / "tests" / layer).is_dir():
            continue
        print(f"\n=== {layer} ===", flush=True)
        outcomes.append(run(layer, for_pytest))
        if outcomes[-1].status == INTERRUPTED:
            break
    return report(outcomes)


def run(layer: str, for_pytest: list[str]) -> Outcome:
    """Run one folder."""
    result = RESULTS / f"{layer}.xml"
    result.unlink(missing_ok=True)
    workers = WORKERS.get(layer, [])
    began = time.monotonic()
    command = [sys.executable, "-m", "pytest", f"tests/{layer}", f"--junit-xml={result}", *workers]
    status = subprocess.run([*command, *for_pytest], cwd=ROOT, check=False).returncode
    seconds = time.monotonic() - began
    if status == NO_TESTS:
        return Outcome(layer, status, seconds=seconds)
    try:
        cases = list(ET.parse(result).getroot().iter("testcase"))  # noqa: S314 - pytest wrote it
    except (OSError, ET.ParseError):
        return Outcome(layer, status or 1, failed=1, seconds=seconds)
    # A test that fails, and again in a fixture's clean-up, has two entries and failed once.
    tests = {(c.get("classname"), c.get("name")): "passed" for c in cases}
    for kind in ("skipped", "failure", "error"):
        tests |= {
            (c.get("classname"), c.get("name")): kind for c in cases if c.find(kind) is not None
        }
    count = Counter(tests.values())
    failed = count["failure"] + count["error"]
    return Outcome(layer, status, count["passed"], failed, count["skipped"], seconds)


def report(outcomes: list[Outcome]) -> int:
    """Print the table, and as the last line the sums."""
    print(f"\n{'':12}{'passed':>8}{'failed':>8}{'skipped':>9}{'seconds':>9}")
    for o in outcomes:
        print(f"{o.layer:12}{o.passed:8}{o.failed:8}{o.skipped:9}{o.seconds:9.0f}")
    passed, failed, skipped = (
        sum(getattr(o, k) for o in outcomes) for k in ("passed", "failed", "skipped")
    )
    seconds = sum(o.seconds for o in outcomes)
    print(f"{'all':12}{passed:8}{failed:8}{skipped:9}{seconds:9.0f}\n")
    print(f"{passed} passed, {failed} failed, {skipped} skipped", flush=True)
    bad = [o.status for o in outcomes if o.status not in (0, NO_TESTS)]
    if bad:
        return bad[0]
    return 0 if passed else NO_TESTS


if __name__ == "__main__":
    RESULTS.mkdir(parents=True, exist_ok=True)
    sys.exit(main())
