"""Threads and tasks whose faults are noticed."""

from __future__ import annotations

import ast
import logging
import threading
from pathlib import Path

import pytest

import rosrm
from rosrm import threads

ROOT = Path(rosrm.__file__).parents[1]
PATIENCE = 10.0


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch):
    """Repeat failing work at once."""
    monkeypatch.setattr(threads, "FIRST_PAUSE", 0.01)


def test_a_loop_runs_again_after_a_fault(caplog):
    """One error of a file or of a peer does not end what serves until the end."""
    turns, served = [], threading.Event()

    def work():
        turns.append(1)
        if len(turns) < 3:
            raise OSError(24, "Too many open files")
        served.set()

    with caplog.at_level(logging.ERROR):
        threads.start(work, "reader", again=True).join(PATIENCE)
    assert served.is_set()
    assert [record.name for record in caplog.records] == ["rosrm.threads"] * 2
    assert "thread reader: OSError: [Errno 24] Too many open files" in caplog.text


def test_the_owner_learns_the_fault(caplog):
    """Work that others wait for ends with its reason."""
    faults = []
    threads.start(lambda: 1 / 0, "start", failed=faults.append).join(PATIENCE)
    assert isinstance(faults[0], ZeroDivisionError)
    assert "it has ended" in caplog.text


def test_the_pauses_double_up_to_a_bound():
    """Work that always fails costs nothing, and its log stays small."""
    pauses = threads.Pauses()
    found = [pauses.after_fault() for _ in range(20)]
    assert found[0] == threads.FIRST_PAUSE
    assert found == sorted(found)
    assert found[-1] == threads.LONGEST_PAUSE


#: Files in which tasks are made, with the reason why their faults are noticed.
TASKS = {
    "rosrm/ros/participant.py": "the guard of callbacks takes the faults",
    "rosrm/node/component_links.py": "the result is the answer to the component",
    "tools/web/rosrm_web/tasks.py": "the one place of the gateway",
    "tools/web/rosrm_web/listings.py": "each reader awaits the task",
    "tools/web/rosrm_web/connections.py": "it ends its connection whatever happens",
}


def test_no_task_is_made_beside_the_guarded_ways():
    """A task that raises is silent until it is collected; ruff finds threads likewise."""
    found = set()
    for folder in ("rosrm", "tools", "plugins"):
        for path in (ROOT / folder).rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
            names = {getattr(call, "attr", getattr(call, "id", "")) for call in calls}
            if names & {"create_task", "ensure_future", "run_coroutine_threadsafe"}:
                found.add(str(path.relative_to(ROOT)))
    assert found == set(TASKS)
