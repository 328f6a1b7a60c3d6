"""Rest of an image after its restore by the shim."""

from __future__ import annotations

import os
import signal

import pytest

from rosrm_criu.engine import restore_result
from tests.criu_kit import TIMEOUT, eventually

pytestmark = pytest.mark.timeout(240)

#: Prints consecutive numbers.
COUNTER = """
import time
count = 0
while True:
    count += 1
    print(count, flush=True)
    time.sleep(0.01)
"""


@pytest.fixture
def directory(theatre):
    """Return the image of a counter that has counted."""
    counter = theatre.start(COUNTER)
    counter.counts()
    return theatre.dump(counter)


@pytest.mark.parametrize("victim", ["the process", "its hold"])
def test_that_it_was_restored_is_known_after_its_end(theatre, directory, victim):
    """The result of a restore survives any early end of the process; its memory is removed."""
    restored = theatre.restore(directory, remove=True)
    told = restored.outcome
    eventually(
        lambda: [path.name for path in directory.iterdir()] == [restore_result.FILE], "its removal"
    )
    pid = restored.pid if victim == "its hold" else restored.outcome.pid
    os.kill(pid, signal.SIGKILL)
    assert restored.process.wait(TIMEOUT) == -signal.SIGKILL
    assert [path.name for path in directory.iterdir()] == [restore_result.FILE]
    assert restore_result.wait(directory, timeout=TIMEOUT, ended=lambda: True) == told


def test_its_program_begins_anew_after_its_end(theatre, directory):
    """Each restart of the shim's command line after the restore runs the program itself."""
    restored = theatre.restore(directory, remove=True)
    restored.process.kill()
    restored.process.wait(TIMEOUT)
    for _ in range(2):
        again = theatre.run(theatre.hold_command(directory, remove=True, then=["echo", "anew"]))
        assert again.process.wait(TIMEOUT) == 0
        assert again.lines() == ["anew\n"]
