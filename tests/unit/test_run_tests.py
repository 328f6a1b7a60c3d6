"""Runner of `make test` with small folders of tests: failed, flaky and last failed ones."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

RUNNER = Path(__file__).resolve().parents[2] / "scripts/run_tests.py"

#: A test that fails the first time and passes from then on.
FLAKY = """
import pathlib, pytest

@pytest.mark.parametrize("case", ["a b", "c[d]"])
class TestFlaky:
    def test_now_and_then(self, case, request):
        print("I am", case)
        mark = pathlib.Path(__file__).with_suffix(f".{case}")
        if not mark.exists():
            mark.touch()
            pytest.fail("the first time")
"""
FAILS = "def test_fails(): assert 0\n"
PASSES = "def test_passes(): pass\n"
#: The first line of the table.
TABLE = f"{'':12}{'passed':>8}{'failed':>8}{'skipped':>9}{'seconds':>9}"


@pytest.fixture
def run_tests(tmp_path, monkeypatch, capfd):
    """Write files below tests/ and run them; return the exit status and the printed lines."""
    spec = importlib.util.spec_from_file_location("run_tests", RUNNER)
    runner = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "run_tests", runner)
    spec.loader.exec_module(runner)
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    monkeypatch.setattr(runner, "RESULTS", tmp_path / "build/test-results")
    monkeypatch.setattr(runner, "WORKERS", {"ros": ["-n", "2", "--dist", "loadfile"]})
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --import-mode=importlib -p xdist\n")
    # plugins take longer to load than the tests run
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")

    def run(files: dict[str, str], *arguments: str) -> tuple[int, list[str]]:
        for name, content in files.items():
            path = tmp_path / "tests" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        monkeypatch.setattr(sys, "argv", ["run_tests.py", *arguments])
        status = runner.main()
        return status, capfd.readouterr().out.splitlines()

    return run


def failures(number: int) -> str:
    """Return tests that each fail the first time only."""
    return FLAKY.replace('["a b", "c[d]"]', f"range({number})")


def test_a_test_that_passes_alone_is_listed_as_flaky(run_tests, tmp_path):
    """The run passes; the name keeps the class and a parameter's brackets and spaces."""
    status, lines = run_tests({"ros/test_a.py": FLAKY, "ros/test_b.py": PASSES})
    assert (status, lines[-1]) == (0, "3 passed, 0 failed, 0 skipped")
    names = [line.split(" (")[0] for line in lines if line.startswith("flaky: ")]
    test = "tests/ros/test_a.py::TestFlaky::test_now_and_then"
    assert names == [f"flaky: {test}[a b]", f"flaky: {test}[c[d]]"]


def test_both_outputs_of_a_flaky_test_are_kept(run_tests, tmp_path):
    run_tests({"faults/test_a.py": failures(1)})
    (kept,) = (tmp_path / "build/test-results/flaky").iterdir()
    failed, _, passed = kept.read_text().partition("--- passed ---")
    assert "the first time" in failed
    assert "I am 0" in failed
    assert "the first time" not in passed
    assert "I am 0" in passed


def faults_of(lines: list[str]) -> dict[str, list[str]]:
    """Return the lines of each failure that stand before the table, by the name of its test."""
    found: dict[str, list[str]] = {}
    for line in lines[: lines.index(TABLE) - 1]:
        if line.startswith("--- how "):
            found[line.removeprefix("--- how ").partition(" failed first: ")[0]] = []
        elif found:
            found[[*found][-1]].append(line)
    return found


def test_the_first_failure_of_a_flaky_test_stands_before_the_table(run_tests):
    """A CI that keeps only the end of the output shows the cause, without the test's output."""
    _, lines = run_tests({"ros/test_a.py": FLAKY, "integration/test_b.py": PASSES})
    faults, test = faults_of(lines), "tests/ros/test_a.py::TestFlaky::test_now_and_then"
    assert [*faults] == [f"{test}[a b]", f"{test}[c[d]]"]
    for fault in faults.values():
        assert "E           Failed: the first time" in fault
        assert not any("I am" in line for line in fault if "print" not in line)


def test_only_the_last_lines_of_a_failure_stand_before_the_table(run_tests):
    """A failure with a long output leaves room for the others."""
    long = f"def test_fails(): assert 0, '\\n'.join(f'line {{n}} {'x' * 1000}' for n in range(99))"
    (fault,) = faults_of(run_tests({"unit/test_a.py": long})[1]).values()
    assert len(fault) == 30
    assert max(map(len, fault)) == 300
    assert "line 98" in "".join(fault)


def test_of_many_failures_some_stand_before_the_table(run_tests):
    _, lines = run_tests({"unit/test_a.py": failures(11)})
    assert len(faults_of(lines)) == 10


def test_flaky_tests_are_counted_by_name_over_the_runs(run_tests, tmp_path):
    run_tests({"integration/test_a.py": failures(1), "integration/test_b.py": failures(1)})
    (tmp_path / "tests/integration/test_a.0").unlink()
    run_tests({})
    for mark in (tmp_path / "tests/integration").glob("*.0"):
        mark.unlink()
    run_tests({})
    counts = json.loads((tmp_path / "build/test-results/flaky.json").read_text())
    assert {name.split("::")[0]: count for name, count in counts.items()} == {
        "tests/integration/test_a.py": 3, "tests/integration/test_b.py": 2,
    }  # fmt: skip


def test_more_than_two_flaky_tests_fail_the_run(run_tests):
    """They count over all folders, and as failed in the exit status."""
    files = {"integration/test_a.py": failures(2), "ros/test_b.py": failures(1) + PASSES}
    status, lines = run_tests(files)
    assert (status, lines[-1]) == (1, "1 passed, 3 failed, 0 skipped")


def test_a_test_that_fails_twice_has_failed(run_tests):
    status, lines = run_tests({"ros/test_a.py": FAILS, "ros/test_b.py": failures(1)})
    assert (status, lines[-1]) == (1, "1 passed, 1 failed, 0 skipped")


@pytest.mark.parametrize("layer", ["unit", "contract"])
def test_a_test_without_real_time_gets_no_second_chance(run_tests, layer):
    status, lines = run_tests({f"{layer}/test_a.py": failures(1)})
    assert (status, lines[-1]) == (1, "0 passed, 1 failed, 0 skipped")


def test_many_failures_get_no_second_chance(run_tests):
    """They have a common cause, and single runs would take long."""
    status, lines = run_tests({"ros/test_a.py": failures(11)})
    assert (status, lines[-1]) == (1, "0 passed, 11 failed, 0 skipped")


def test_what_failed_last_is_run_alone(run_tests):
    """`--lf` leaves out folders without failures and tests that passed."""
    files = {
        "unit/test_a.py": PASSES, "contract/test_b.py": FAILS + PASSES,
        "ros/test_c.py": FAILS + PASSES, "ros/test_d.py": PASSES,
    }  # fmt: skip
    status, lines = run_tests(files)
    assert (status, lines[-1]) == (1, "4 passed, 2 failed, 0 skipped")
    status, lines = run_tests({"ros/test_c.py": FAILS.replace("0", "1")}, "--lf")
    assert (status, lines[-1]) == (1, "1 passed, 1 failed, 0 skipped")
    assert not any("unit" in line for line in lines)


def test_a_test_beside_another_run_has_more_time(run_tests, tmp_path):
    """On a busy machine, a sound test with less priority took longer than the usual limit."""
    with (tmp_path / "pytest.ini").open("a") as ini:
        ini.write("timeout = 120\n")
    limit = "def test_limit(pytestconfig): assert float(pytestconfig.getini('timeout')) == {}\n"
    files = {"unit/test_a.py": limit.format(600), "ros/test_b.py": limit.format(120)}
    status, _ = run_tests(files, "-p", "pytest_timeout")
    assert status == 0


def test_what_fails_beside_another_run_is_shown_and_remembered(run_tests):
    """The unit tests run beside the next folder: their output follows, and `--lf` finds both."""
    files = {"unit/test_a.py": FAILS, "integration/test_b.py": FAILS}
    status, lines = run_tests(files)
    assert (status, lines[-1]) == (1, "0 passed, 2 failed, 0 skipped")
    assert [line for line in lines if line.startswith("FAILED tests/unit/test_a.py")]
    _, lines = run_tests({}, "--lf")
    assert lines[-1] == "0 passed, 2 failed, 0 skipped"


def test_where_nothing_failed_last_all_is_run(run_tests):
    run_tests({"unit/test_a.py": PASSES, "ros/test_b.py": PASSES})
    status, lines = run_tests({}, "--lf")
    assert (status, lines[-1]) == (0, "2 passed, 0 failed, 0 skipped")


def test_a_file_that_cannot_be_imported_has_failed(run_tests):
    status, lines = run_tests({"ros/test_a.py": "import nothing_of_this_name", "ros/test_b.py": ""})
    assert status != 0
    assert lines[-1] == "0 passed, 1 failed, 0 skipped"


def test_nothing_to_run_is_no_success(run_tests):
    status, lines = run_tests({"unit/test_a.py": PASSES}, "-k", "nothing")
    assert (status, lines[-1]) == (5, "0 passed, 0 failed, 0 skipped")
