"""Steps of a move by criu that copy the memory of the running node; none of them fails a move."""

from __future__ import annotations

import subprocess
import sys
import threading
from itertools import count

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import page_server
from rosrm_criu.engine.memory_copy import CHANGES, file_name
from rosrm_criu.engine.paths import received_copy, sent_copy
from rosrm_criu.executors import artifacts, attempts, precopy
from rosrm_criu.executors.request import StepArguments
from rosrm_criu.plans import (
    COPY_CHANGES,
    COPY_MEMORY,
    EXPECT_COPY,
    FETCH_CHANGES,
    FETCH_COPY,
    INTRODUCE,
    MEASURE_MEMORY,
)
from rosrm_criu.transfer import Sender, missing
from tests.waiting import PATIENCE, wait_until

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing() or "-")

_numbers = count(1)
#: Holds so many bytes, and changes as many of them as each line of input says.
HOLDER = """
import sys
held = bytearray(b"1") * int(sys.argv[1])
print(flush=True)
for line in sys.stdin:
    held[: int(line)] = bytes(int(line))
    print(flush=True)
"""


class Steps:
    """Calls of the executors for one move, with the results of the former ones.

    Args:
        folder: of source and destination.
        size: bytes of the memory of the process that moves.
    """

    def __init__(self, folder, size: int = 2 * precopy.LEAST) -> None:
        self.folder, self.number = folder, next(_numbers)
        self.results: dict[str, object] = {}
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", HOLDER, str(size)], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )  # fmt: skip
        assert self.process.stdout.readline()

    def arguments(self, **changes):
        here = {
            "host": "h", "state": str(self.folder), "pids": {f"p#{self.number}": self.process.pid},
            "instances": [], "options": {},
        }  # fmt: skip
        return {
            "process": "p", "source": self.number, "destination": self.number,
            "attempt": f"p#{self.number}", "timeout": PATIENCE, "here": here, "keep": 600.0,
            "offer": 60.0, "max_rate": 0, "reserve": 0, "results": self.results, **changes,
        }  # fmt: skip

    def call(self, name: str, step, **changes):
        answer = step(self.arguments(**changes))
        if answer:  # the master keeps no empty result
            self.results[name] = answer
        return answer

    def change(self, size: int) -> None:
        """Let the process write so many bytes of its memory."""
        self.process.stdin.write(b"%d\n" % size)
        self.process.stdin.flush()
        assert self.process.stdout.readline()

    def until_offered(self) -> None:
        self.call(MEASURE_MEMORY, precopy.measure_memory)
        self.call(EXPECT_COPY, precopy.expect_copy)
        self.call(COPY_MEMORY, precopy.copy_memory)

    def fetch(self, **changes):
        return self.call(FETCH_COPY, precopy.fetch_copy, **changes)

    @property
    def received(self) -> str:
        return precopy.received_fingerprint(StepArguments.of(self.arguments()))

    @property
    def there(self):
        return received_copy(self.folder, self.number)

    def close(self) -> None:
        precopy.remove_sent_copy(self.folder, self.number)
        precopy.remove_received_copy(self.folder, self.number)
        if fetcher := artifacts.take_fetcher(self.number):
            fetcher.close()
        self.process.communicate()


@pytest.fixture
def steps(tmp_path):
    one = Steps(tmp_path)
    yield one
    one.close()


def test_a_copy_is_at_the_destination_before_the_dump(steps):
    """The destination names the offer of its copy, and a sweep by the same slave keeps the copy."""
    steps.until_offered()
    answer = steps.fetch()
    assert answer["received"] > 0
    assert steps.received == steps.results[COPY_MEMORY]["offer"]["fingerprint"]
    precopy.sweep(steps.folder)
    assert [path.name for path in steps.there.iterdir()] == [file_name(steps.process.pid)]


def test_what_changes_during_the_copy_is_at_the_destination_too(steps):
    """The destination then names the offer of the second copy."""
    steps.until_offered()
    steps.fetch()
    steps.change(precopy.LEAST_CHANGES)
    steps.call(COPY_CHANGES, precopy.copy_changes)
    answer = steps.call(FETCH_CHANGES, precopy.fetch_changes)
    assert answer["received"] > 0
    assert steps.received == steps.results[COPY_CHANGES]["offer"]["fingerprint"]
    [pages] = (steps.there / CHANGES).iterdir()
    assert precopy.LEAST_CHANGES <= pages.stat().st_size < precopy.LEAST


@pytest.mark.parametrize("size", [0, 2 * precopy.LEAST])
def test_few_and_many_changes_are_left_to_the_dump(steps, size):
    """The first copy stays in use."""
    steps.until_offered()
    steps.fetch()
    if size:
        steps.change(size)
    assert "too few or too many" in steps.call(COPY_CHANGES, precopy.copy_changes)["skipped"]
    assert steps.call(FETCH_CHANGES, precopy.fetch_changes) == {}
    assert steps.received == steps.results[COPY_MEMORY]["offer"]["fingerprint"]
    assert not (sent_copy(steps.folder, steps.number) / CHANGES).exists()


def test_changes_that_do_not_arrive_are_no_failure(steps):
    """The first copy stays in use."""
    steps.until_offered()
    steps.fetch()
    steps.change(precopy.LEAST_CHANGES)
    steps.call(COPY_CHANGES, precopy.copy_changes)
    answer = steps.call(FETCH_CHANGES, precopy.fetch_changes, reserve=10**15)
    assert "do not fit beside" in answer["skipped"]
    assert steps.received == steps.results[COPY_MEMORY]["offer"]["fingerprint"]
    assert not (steps.there / CHANGES).exists()


def test_little_memory_is_not_copied(tmp_path):
    """No process is started for it, and nothing is written."""
    steps = Steps(tmp_path, size=1 << 20)
    steps.until_offered()
    assert steps.results == {MEASURE_MEMORY: {"bytes": 0}}
    assert steps.fetch() == {}
    steps.close()
    assert not list(tmp_path.iterdir())


def test_no_room_at_the_destination_is_no_failure(steps):
    """The room has to hold the whole dump too, beside the reserve."""
    steps.until_offered()
    assert "do not fit beside" in steps.fetch(reserve=10**15)["skipped"]
    assert steps.received == ""
    assert not steps.there.exists()


def test_a_process_that_has_ended_is_no_failure(steps):
    """If the process ends between two steps, the later steps make and fetch no copy."""
    steps.call(MEASURE_MEMORY, precopy.measure_memory)
    steps.call(EXPECT_COPY, precopy.expect_copy)
    steps.process.communicate()
    answer = steps.call(COPY_MEMORY, precopy.copy_memory)
    assert f"p#{steps.number} does not run on h" in answer["skipped"]
    assert steps.fetch() == {}
    assert not sent_copy(steps.folder, steps.number).exists()


def test_a_copy_that_is_undone_while_it_is_under_way_is_given_up(steps):
    """The source does not offer it, and keeps no part of it."""
    steps.call(MEASURE_MEMORY, precopy.measure_memory)
    steps.call(EXPECT_COPY, precopy.expect_copy)
    precopy.remove_copy(steps.arguments())
    assert "was undone" in steps.call(COPY_MEMORY, precopy.copy_memory)["skipped"]
    assert not list((steps.folder / "images").iterdir())


def test_a_move_that_is_undone_while_pages_are_received_causes_no_second_dump(steps, monkeypatch):
    """The slave cannot receive the pages; the node rejoins instead."""
    steps.until_offered()
    steps.fetch()
    steps.results[INTRODUCE] = {"copy": steps.received}
    receive = precopy.receiver(StepArguments.of(steps.arguments()))

    def serve(*_, **__):
        attempts.turn_back(f"p#{steps.number}")

    monkeypatch.setattr(page_server, "serve", serve)
    with pytest.raises(CriuError, match="was undone"):
        receive(lambda _: None, steps.folder)


@pytest.mark.parametrize("fetched", [False, True])
def test_an_undone_copy_leaves_nothing(steps, fetched):
    """The undo removes it at both ends, with the end that would receive it."""
    steps.until_offered()
    if fetched:
        assert steps.fetch()["received"] > 0
    precopy.remove_copy(steps.arguments())
    assert not list((steps.folder / "images").iterdir())
    assert steps.received == ""
    assert artifacts.take_fetcher(steps.number) is None


def test_a_source_that_withdraws_its_copy_is_no_failure(steps):
    """The destination keeps no part of it."""
    steps.until_offered()
    precopy.remove_sent_copy(steps.folder, steps.number)
    assert "cannot be reached" in steps.fetch()["skipped"]
    assert steps.received == ""
    assert not steps.there.exists()


def test_a_copy_with_other_files_is_refused(steps, tmp_path):
    """The destination would put them into an image."""
    steps.until_offered()
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "core-1.img").write_bytes(b"registers")
    with Sender() as sender:
        to = steps.results[EXPECT_COPY]["certificate"]
        offer = sender.offer(strange, seconds=60.0, to=to).as_json()
        steps.results[COPY_MEMORY] = {"offer": offer}
        assert "other files than pages" in steps.fetch()["skipped"]
    assert not steps.there.exists()


def test_a_repeated_step_gives_the_same_copy(steps):
    """A restarted master asks again; the copy under way is the only one."""
    steps.call(MEASURE_MEMORY, precopy.measure_memory)
    steps.call(EXPECT_COPY, precopy.expect_copy)
    answers = []
    threads = [
        threading.Thread(
            target=lambda: answers.append(precopy.copy_memory(steps.arguments())), daemon=True
        )
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert len(answers) == 2
    assert answers[0] == answers[1]
    assert "offer" in answers[0]


def test_an_unused_copy_expires_at_the_source(steps):
    """A move that was given up leaves nothing."""
    steps.call(MEASURE_MEMORY, precopy.measure_memory)
    steps.call(EXPECT_COPY, precopy.expect_copy)
    assert "offer" in steps.call(COPY_MEMORY, precopy.copy_memory, keep=0.1)
    images = steps.folder / "images"
    wait_until(lambda: not list(images.iterdir()), "the sent copy is removed")


def test_an_unused_copy_expires_at_the_destination(steps):
    """A move that was given up leaves nothing."""
    steps.until_offered()
    steps.fetch(keep=0.1)
    wait_until(lambda: not steps.there.exists(), "the received copy is removed")
    assert steps.received == ""


def test_copies_of_a_former_slave_are_removed(tmp_path):
    """A new slave has no offers of its predecessor, so no step can use these copies."""
    for place in (sent_copy(tmp_path, 1), received_copy(tmp_path, 1)):
        place.mkdir(parents=True)
    precopy.sweep(tmp_path)
    assert not list((tmp_path / "images").iterdir())
