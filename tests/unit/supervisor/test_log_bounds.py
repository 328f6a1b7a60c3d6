"""Bound on the bytes of all logs of a host."""

from __future__ import annotations

import json
import os

import pytest

from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.rules import Key, RestartRule, StopRule
from rosrm.supervisor import messages, paths
from rosrm.supervisor.logs import LogKeeper, LogLimits

LIMITS = LogLimits(max_bytes=1000, keep=12, keep_bytes=10_000)


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    return folder


def total(folder) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())


def not_ended(*processes: str) -> dict[Key, Instance]:
    return {(name, 1): Instance((name, 1), RestartRule(), StopRule()) for name in processes}


def run(keeper, key, *outputs: int) -> None:
    """Run an instance that writes so many bytes before each look at its log."""
    log = keeper.open(key)
    keeper.watch(key, 0.0, 7)
    for size in outputs:
        os.write(log, b"x" * size)
        keeper.look(keeper.deadline())
    os.close(log)


def test_the_logs_of_the_oldest_processes_are_removed_first(tmp_path, folder):
    """A thousand jobs that end leave no more than the bound."""
    keeper = LogKeeper(str(tmp_path), LIMITS, {})
    for number in range(40):
        run(keeper, (f"job{number}", 1), 900)
        (folder / f"job{number}.1.parameters.yaml").touch()
        keeper.release((f"job{number}", 1))
    left = {path.name.partition(".")[0] for path in folder.iterdir()}
    assert LIMITS.keep_bytes / 2 < total(folder) <= LIMITS.keep_bytes * 1.1
    assert left == {f"job{number}" for number in range(40 - len(left), 40)}


def test_older_files_of_running_processes_are_removed_when_nothing_else_is_left(tmp_path, folder):
    """Current files stay: a process writes into its own."""
    keeper = LogKeeper(str(tmp_path), LIMITS, not_ended("a", "b"))
    run(keeper, ("ended", 1), 500)
    keeper.release(("ended", 1))
    for name in ("a", "b"):
        run(keeper, (name, 1), *[1100] * 12, 500)
    names = {path.name for path in folder.iterdir()}
    assert total(folder) <= LIMITS.keep_bytes * 1.15
    assert not any(name.startswith("ended") for name in names)
    assert {"a.1.log", "b.1.log"} <= names
    for name in ("a", "b"):  # the oldest went first: no gap that a reader could stop at
        ages = sorted(paths.age_of(one) for one in names if one.startswith(name))
        assert set(ages) == set(range(max(ages) + 1))


def test_a_log_that_was_opened_ahead_stays(tmp_path, folder):
    """Its process is going to write into it."""
    keeper = LogKeeper(str(tmp_path), LIMITS, not_ended("held"))
    keeper.prepare(("held", 1))
    for number in range(40):
        run(keeper, (f"job{number}", 1), 900)
        keeper.release((f"job{number}", 1))
    assert (folder / "held.1.log").exists()
    assert not (folder / "job0.1.log").exists()
    keeper.release(("held", 1))
    assert not (folder / "held.1.log").exists()


def test_logs_of_a_former_supervisor_count(tmp_path, folder):
    for number in range(30):
        (folder / f"job{number:02}.1.log").write_bytes(b"x" * 1000)
    keeper = LogKeeper(str(tmp_path), LIMITS, not_ended("new"))
    run(keeper, ("new", 1), 10)
    assert total(folder) <= LIMITS.keep_bytes
    assert (folder / "new.1.log").exists()


@pytest.mark.parametrize(
    ("name", "instance", "age"),
    [
        ("a.1.log", ("a", 1), 0),
        ("a.1.log.times", ("a", 1), 0),
        ("a.1.log.12", ("a", 1), 12),
        ("a.1.log.12.times.new", ("a", 1), 12),
        ("a.1.parameters.yaml", ("a", 1), 0),
        ("a.1.log.2.log.3", ("a.1.log", 2), 3),
        ("a.log", None, 0),
        ("core", None, 0),
    ],
)
def test_each_file_belongs_to_an_instance(name, instance, age):
    assert paths.instance_of(name) == instance
    assert paths.age_of(name) == age


def test_a_slave_of_an_earlier_release_sends_no_bound():
    """Its supervisor takes the default; an earlier supervisor reads the first four limits."""
    hello = messages.encode_order(messages.Hello(3, 1, LIMITS))
    fields = json.loads(hello)
    assert len(fields["log"]) == 4
    assert messages.decode_order(hello).log == LIMITS
    del fields["log_bytes"]
    order = messages.decode_order(json.dumps(fields).encode())
    assert order.log == LIMITS._replace(keep_bytes=LogLimits().keep_bytes)
