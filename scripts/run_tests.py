"""Run the tests in a few runs of pytest and close with one table: `make test`.

The unit tests, which compute, run beside the integration tests, which mostly wait. In the folders
that run in real time, a failed test is run once more, alone, at the end of its run. If it passes
then, it is listed as flaky; both outputs are in build/test-results/flaky. More than two flaky tests
fail. The end of each failure stands before the table, because a CI often keeps only the end of a
long output. `--lf` runs what failed last, and only the folders that hold it.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "build" / "test-results"

#: The folders under tests/, in the order in which their results are shown.
LAYERS = ("unit", "contract", "fuzz", "integration", "ros", "faults")

#: The runs of pytest, in this order. A run with its output in a file runs beside the next ones.
RUNS = (("contract",), ("fuzz",), ("unit",), ("integration",), ("ros", "faults"))
BESIDE = "unit"
#: Longest time, in seconds, of one test of that run: it has less priority than what it runs beside,
#: and a test that takes 7 s alone has taken more than 120 s.
LONGEST_BESIDE = 600

#: Workers of the folders that run in parallel. Tests in real time mostly wait, so that a core
#: serves two of them. With a ROS graph, each worker has a network of its own, if permitted. Tests
#: that share a cluster run on one worker, the longest first (tests/conftest.py).
_REAL_TIME_WORKERS = ["-n", "4", "--dist", "loadscope", "--no-loadscope-reorder"]
WORKERS = {
    "unit": ["-n", "2"],
    "fuzz": ["-n", "2"],
    "integration": _REAL_TIME_WORKERS,
    "ros": _REAL_TIME_WORKERS,
    "faults": _REAL_TIME_WORKERS,
}

#: Folders whose tests depend on the load of the machine: a failed test gets a second chance.
REAL_TIME = ("integration", "ros", "faults")
#: More failures than this in one folder have a common cause: none gets a second chance.
SECOND_CHANCES = 10
#: More flaky tests than this fail a run.
FLAKY_ALLOWED = 2
#: Last lines of a failure that are shown again before the table, and the longest of them.
FAULT_LINES, FAULT_WIDTH = 30, 300
#: Most failed tests that are shown there; the flaky ones are all shown.
FAULTS_SHOWN = 10

# Of pytest's exit statuses:
TESTS_FAILED = 1
INTERRUPTED = 2
NO_TESTS = 5


@dataclass(frozen=True)
class Test:
    """One test of one run of pytest.

    Attributes:
        outcome: "passed", "failed" or "skipped".
        text: its errors and its output.
        fault: its errors alone: tracebacks.
    """

    outcome: str
    text: str
    fault: str


@dataclass(frozen=True)
class Outcome:
    """The result of one run.

    Attributes:
        flaky: names of the tests that failed, and then passed alone.
        faults: name of each test that failed, the flaky ones too, to its first failure.
    """

    folders: tuple[str, ...]
    status: int
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    flaky: tuple[str, ...] = ()
    faults: Mapping[str, str] = field(default_factory=dict)


def main() -> int:
    """Run the chosen folders; return the exit status of the first pytest that failed."""
    began = time.monotonic()
    RESULTS.mkdir(parents=True, exist_ok=True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layers", nargs="+", choices=LAYERS, default=LAYERS)
    options, for_pytest = parser.parse_known_args()
    # Ctrl-C reaches pytest too, which then ends its tests: wait for it, then report.
    signal.signal(signal.SIGINT, lambda *_: None)
    folders = {layer for layer in options.layers if (ROOT / "tests" / layer).is_dir()}
    if {"--lf", "--last-failed"} & set(for_pytest):
        folders = failed_last(folders) or folders
    chosen = [run for some in RUNS if (run := tuple(one for one in some if one in folders))]
    with ThreadPoolExecutor(max_workers=1) as aside:
        beside = None
        outcomes = []
        for run in chosen:
            if run == (BESIDE,) and run != chosen[-1]:
                beside = aside.submit(run_folders, run, for_pytest, RESULTS / f"{BESIDE}.txt")
                continue
            outcomes.append(run_folders(run, for_pytest))
            if outcomes[-1].status == INTERRUPTED:
                break
        if beside is not None:
            outcomes.insert(0, beside.result())
            print(f"\n=== {BESIDE}, which ran beside ===", flush=True)
            print((RESULTS / f"{BESIDE}.txt").read_text(), flush=True)
    return report(outcomes, time.monotonic() - began)


def failed_last(folders: set[str]) -> set[str]:
    """Return the folders in which a test failed when it was run last."""
    failed: list[str] = []
    for cache in (ROOT / ".pytest_cache").glob("*/v/cache/lastfailed"):
        failed += json.loads(cache.read_text())
    return {one for one in folders if any(name.startswith(f"tests/{one}/") for name in failed)}


def run_folders(
    folders: tuple[str, ...], for_pytest: list[str], output: Path | None = None
) -> Outcome:
    """Run some folders, and then run their failed tests once more, one by one.

    Args:
        folders: below tests/; they run with the same workers.
        for_pytest: further arguments.
        output: file for the output of pytest; None: this process's own output.
    """
    began = time.monotonic()
    name = "-".join(folders)
    if output is None:
        print(f"\n=== {' and '.join(folders)} ===", flush=True)
    places = [f"tests/{folder}" for folder in folders]
    status, tests = run_pytest(
        name, [*places, *WORKERS.get(folders[0], []), *for_pytest], output=output
    )
    if tests is None:
        failed = 0 if status == NO_TESTS else 1
        return Outcome(folders, status or 1, failed=failed, seconds=time.monotonic() - began)
    failures = [name for name, test in tests.items() if test.outcome == "failed"]
    flaky: tuple[str, ...] = ()
    may_try = folders[0] in REAL_TIME and len(failures) <= SECOND_CHANCES
    if status == TESTS_FAILED and may_try:
        print(f"\n=== {len(failures)} failed, each once more, alone ===", flush=True)
        known = [one for one in failures if one.startswith(tuple(f"{place}/" for place in places))]
        again = (run_pytest(f"{name}-again", known)[1] if known else None) or {}
        flaky = tuple(one for one in failures if one in again and again[one].outcome == "passed")
        for one in flaky:
            keep_outputs(one, tests[one], again[one])
        if len(flaky) == len(failures):
            status = 0
    count = Counter(test.outcome for test in tests.values())
    return Outcome(
        folders, status, count["passed"] + len(flaky), len(failures) - len(flaky), count["skipped"],
        time.monotonic() - began, flaky, {one: tests[one].fault for one in failures},
    )  # fmt: skip


def run_pytest(
    name: str, arguments: list[str], *, output: Path | None = None
) -> tuple[int, dict[str, Test] | None]:
    """Run pytest; return its exit status, and its tests by node id (None: it wrote no result)."""
    result = RESULTS / f"{name}.xml"
    result.unlink(missing_ok=True)
    command = [
        # Tests in real time run beside a run with its output in a file, which gets less priority.
        *(("nice", "-n", "5") if output else ()),
        *(sys.executable, "-m", "pytest", f"--junit-xml={result}", "-o", "junit_logging=all"),
        # Each run has its own list of failed tests: two runs that end at once would lose one.
        *("-o", f"cache_dir=.pytest_cache/{name.removesuffix('-again')}"),
        *("--durations=20", "--durations-min=5"),
        *(("-o", f"timeout={LONGEST_BESIDE}") if output else ()),
    ]
    with output.open("w") if output else nullcontext() as target:
        ended = subprocess.run([*command, *arguments], cwd=ROOT, check=False, stdout=target)
    status = ended.returncode
    if status == NO_TESTS:
        return status, None
    try:
        cases = list(ET.parse(result).getroot().iter("testcase"))  # noqa: S314 - pytest wrote it
    except (OSError, ET.ParseError):
        return status, None
    tests: dict[str, Test] = {}
    for case in cases:
        # A test that fails in its body and in a fixture's clean-up has two entries; count it once.
        former = tests.get(node_id(case), Test("", "", ""))
        tests[node_id(case)] = Test(
            "failed" if former.outcome == "failed" else outcome_of(case),
            former.text + "\n".join(case.itertext()),
            former.fault + fault_of(case),
        )
    return status, tests


def node_id(case: ET.Element) -> str:
    """Return the name by which pytest runs a test: "tests/ros/test_a.py::Class::test_b[c]"."""
    parts = case.get("classname", "").split(".")
    for length in range(len(parts), 0, -1):
        path = "/".join(parts[:length]) + ".py"
        if (ROOT / path).is_file():
            return "::".join([path, *parts[length:], case.get("name", "")])
    return f"{case.get('classname')}::{case.get('name')}"  # a file that could not be imported


def outcome_of(case: ET.Element) -> str:
    """Return "passed", "failed" or "skipped"."""
    if case.find("failure") is not None or case.find("error") is not None:
        return "failed"
    return "skipped" if case.find("skipped") is not None else "passed"


def fault_of(case: ET.Element) -> str:
    """Return the tracebacks of a test that failed; "" if it did not."""
    faults = [*case.findall("failure"), *case.findall("error")]
    return "".join(f"{one.text or one.get('message', '')}\n" for one in faults)


def keep_outputs(name: str, first: Test, second: Test) -> None:
    """Write both outputs of a flaky test, failed and passed, to a file."""
    path = RESULTS / "flaky" / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)}.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{name}\n\n--- failed ---\n{first.text}\n--- passed ---\n{second.text}\n")


def report(outcomes: list[Outcome], seconds: float) -> int:
    """Print the failures, the table, and as the last line the sums; return the exit status."""
    print_faults(outcomes)
    print(f"\n{'':12}{'passed':>8}{'failed':>8}{'skipped':>9}{'seconds':>9}")
    for o in outcomes:
        name = "+".join(o.folders)
        print(f"{name:12}{o.passed:8}{o.failed:8}{o.skipped:9}{o.seconds:9.0f}")
    passed, failed, skipped = (
        sum(getattr(o, k) for o in outcomes) for k in ("passed", "failed", "skipped")
    )
    print(f"{'all':12}{passed:8}{failed:8}{skipped:9}{seconds:9.0f}\n")
    flaky = [name for o in outcomes for name in o.flaky]
    counts = count_flaky(flaky)
    for name in flaky:
        print(f"flaky: {name} (failed, then passed alone; {counts[name]} times so far)")
    too_many = len(flaky) > FLAKY_ALLOWED
    if too_many:
        print(f"{len(flaky)} tests are flaky, at most {FLAKY_ALLOWED} may be: they count as failed")
        passed, failed = passed - len(flaky), failed + len(flaky)
    print(f"{passed} passed, {failed} failed, {skipped} skipped", flush=True)
    bad = [o.status for o in outcomes if o.status not in (0, NO_TESTS)]
    if bad or too_many:
        return bad[0] if bad else TESTS_FAILED
    return 0 if passed else NO_TESTS


def print_faults(outcomes: list[Outcome]) -> None:
    """Print the end of the first failure of each flaky test, and of some of the other ones."""
    failed = [(n, o.faults[n]) for o in outcomes for n in o.faults if n not in o.flaky]
    flaky = [(n, o.faults[n]) for o in outcomes for n in o.flaky]
    for name, fault in [*failed[:FAULTS_SHOWN], *flaky]:
        lines = fault.strip().splitlines()[-FAULT_LINES:]
        print(f"\n--- how {name} failed first: the last lines ---")
        print("\n".join(line[:FAULT_WIDTH] for line in lines))


def count_flaky(flaky: list[str]) -> Counter[str]:
    """Add the flaky tests of this run to the counts in build/test-results/flaky.json."""
    path = RESULTS / "flaky.json"
    counts = Counter(json.loads(path.read_text()) if path.exists() else {})
    counts.update(flaky)
    path.write_text(json.dumps(counts, indent=2, sort_keys=True) + "\n")
    return counts


if __name__ == "__main__":
    sys.exit(main())
