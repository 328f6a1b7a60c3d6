"""Executors of checkpoints and restores, with real processes and a working CRIU."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
from pathlib import Path
from typing import Any

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import image, process_tree, restore_result
from rosrm_criu.engine.paths import checkpoint, checkpoint_ports, incoming, numbers
from rosrm_criu.executors import artifacts, attempts
from rosrm_criu.executors import checkpoint as steps
from tests.criu_kit import TIMEOUT, eventually

pytestmark = pytest.mark.timeout(240)

#: Prints a UDP port that it holds, then consecutive numbers.
COUNTER = """
import socket, time
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
one.bind(("127.0.0.1", 0))
print("port", one.getsockname()[1], flush=True)
count = 0
while True:
    count += 1
    print(count, flush=True)
    time.sleep(0.01)
"""


class Slave:
    """Caller of the executors, in the role of a host's slave.

    Args:
        theatre: starts and restores the processes.
        state: the slave's directory.
    """

    def __init__(self, theatre: Any, state: Path) -> None:
        self.theatre, self.state = theatre, state
        self.pids: dict[str, int] = {}
        self.results: dict[str, Any] = {}

    def ask(self, step: str, *, source: int = 1, destination: int = 2, **more: Any) -> Any:
        arguments = {
            "process": "p", "source": source, "destination": destination, "timeout": TIMEOUT,
            "attempt": f"p#{source}-{destination}", "results": self.results, **more,
            "here": {
                "host": "here", "state": str(self.state), "pids": self.pids,
                "instances": list(self.pids),
            },
        }  # fmt: skip
        answer = getattr(steps, step)(arguments)
        json.dumps(answer)
        if answer:
            self.results[f"criu_{step}"] = answer
        return answer

    def shim(self, number: int = 2) -> Any:
        """Start the shim of an instance like the supervisor does."""
        actor = self.theatre.shim(incoming(self.state, number), remove=True)
        self.pids[f"p#{number}"] = actor.pid
        return actor

    def end(self, actor: Any) -> None:
        process_tree.send(reversed(process_tree.tree(actor.pid)), 9)
        actor.process.wait(TIMEOUT)


@pytest.fixture
def slave(theatre, tmp_path):
    """Return a slave that was just started and remembers no attempt."""
    attempts._flights.clear()
    attempts._turned_back.clear()
    return Slave(theatre, tmp_path / "state")


@pytest.fixture
def counter(slave, theatre):
    """Return a running counter, as instance p#1."""
    actor = theatre.start(COUNTER)
    actor.counts()
    slave.pids["p#1"] = actor.pid
    return actor


def port_of(actor: Any) -> int:
    return int(actor.lines()[0].split()[1])


def is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def checkpointed(slave: Slave, counter: Any) -> list[int]:
    """Checkpoint the counter; return all numbers that it printed before."""
    slave.ask("keep")
    slave.ask("kill")
    counter.process.wait(TIMEOUT)
    slave.results.clear()
    return counter.numbers()


def check_continued(before: list[int], restored: Any) -> None:
    """Check that a restored counter lost and repeated no number."""
    printed = before + restored.numbers()  # read once, because the process still counts
    assert printed == list(range(1, printed[-1] + 1))


def nothing_left(slave: Slave) -> None:
    assert numbers(slave.state, "kept") == []
    assert not list((slave.state / "images").glob("kept-*"))


def test_a_process_continues_from_its_image_with_its_port(slave, counter):
    """A restored process loses and repeats no number, and its port stays reserved until then."""
    before, port = checkpointed(slave, counter), port_of(counter)
    assert numbers(slave.state, "kept") == [1]
    assert not is_free(port)
    slave.ask("take", destination=3)
    restored = slave.shim(3)
    assert slave.ask("await_checkpoint", destination=3)["seconds"]["restore"] > 0.0
    restored.counts()
    check_continued(before, restored)
    nothing_left(slave)
    slave.end(restored)
    eventually(lambda: is_free(port), "the port free")  # the restored process ends with its shim


def test_a_restored_process_can_be_checkpointed_again(slave, counter):
    """A restored process can be checkpointed as the instance of its shim."""
    before = checkpointed(slave, counter)
    slave.ask("take", destination=3)
    restored = slave.shim(3)
    slave.ask("await_checkpoint", destination=3)
    restored.counts()
    slave.ask("keep", source=3, destination=4)
    slave.ask("kill", source=3, destination=4)
    restored.process.wait(TIMEOUT)
    slave.ask("take", source=3, destination=5)
    again = slave.shim(5)
    slave.ask("await_checkpoint", source=3, destination=5)
    again.counts()
    check_continued(before + restored.numbers(), again)
    slave.end(again)


def test_a_checkpoint_that_is_undone_lets_it_run_on(slave, counter):
    """An undo continues the stopped process and removes the image, and can be repeated."""
    slave.ask("keep")
    assert slave.ask("keep") == slave.results["criu_keep"]
    assert process_tree.is_stopped(counter.pid)
    printed = counter.numbers()
    slave.ask("run_on")
    slave.ask("run_on")
    counter.counts()
    after = counter.numbers()  # read once, because the process still counts
    assert after == list(range(1, after[-1] + 1)) > printed
    nothing_left(slave)


def test_a_dump_that_comes_after_its_undo_is_none(slave, counter):
    """A dump command that arrives after its undo fails, and the process runs on."""
    slave.ask("run_on", destination=30)
    with pytest.raises(CriuError, match="was undone"):
        slave.ask("keep", destination=30)
    counter.counts()


def test_an_undo_after_its_end_only_removes_the_image(slave, counter):
    """An undo after the end of the process only removes the image."""
    slave.ask("keep", destination=31)
    slave.end(counter)
    assert slave.ask("run_on", destination=31) == {}
    nothing_left(slave)


def test_what_cannot_be_dumped_runs_on(slave, theatre):
    """A process with an external pipe runs on; the error names descriptor and other end."""
    reading, writing = os.pipe()
    actor = theatre.start(COUNTER, pass_fds=(writing,))
    actor.counts()
    slave.pids["p#1"] = actor.pid
    with pytest.raises(CriuError, match=rf"descriptor {writing} .* is a pipe .*{os.getpid()}"):
        slave.ask("keep", destination=32)
    actor.counts()
    nothing_left(slave)
    os.close(reading)
    os.close(writing)


def test_an_undone_restore_leaves_the_image_as_it_was(slave, counter):
    """An undo before the restore, or after its failure, keeps the image restorable."""
    before = checkpointed(slave, counter)
    slave.ask("take")
    assert slave.ask("put_back") == {}
    assert not incoming(slave.state, 2).exists()
    slave.ask("take")
    page = next((incoming(slave.state, 2) / image.PAGES).glob("core-*"))
    page.unlink()  # only the hard link
    failed = slave.shim()
    with pytest.raises(CriuError, match="damaged"):
        slave.ask("await_checkpoint")
    failed.process.wait(TIMEOUT)
    assert slave.ask("put_back") == {}
    slave.ask("take")
    restored = slave.shim()
    slave.ask("await_checkpoint")
    restored.counts()
    check_continued(before, restored)
    slave.end(restored)


def test_an_image_that_changed_on_the_disk_is_not_restored(slave, counter):
    """A flipped bit in an image fails the restore with advice, and the image stays."""
    checkpointed(slave, counter)
    pages = checkpoint(slave.state, 1) / image.PAGES / "pages-1.img"
    content = bytearray(pages.read_bytes())
    content[len(content) // 2] ^= 1
    pages.write_bytes(content)
    slave.ask("take")
    failed = slave.shim()
    with pytest.raises(CriuError, match=r"damaged: criu/pages-1\.img .* `rosrm restart p`"):
        slave.ask("await_checkpoint")
    failed.process.wait(TIMEOUT)
    assert slave.ask("put_back") == {}
    assert numbers(slave.state, "kept") == [1]
    steps.drop({"numbers": [1], "here": {"state": str(slave.state)}})


def test_a_restored_process_is_not_put_back(slave, counter):
    """A successful restore is never undone, even if unreported or if the process has ended."""
    checkpointed(slave, counter)
    slave.ask("take")
    restored = slave.shim()
    eventually(lambda: restore_result.read(incoming(slave.state, 2)), "the restore")
    assert slave.ask("put_back") == {"active": True}
    nothing_left(slave)
    restored.counts()
    assert slave.ask("put_back") == {"active": True}
    slave.end(restored)
    shutil.rmtree(incoming(slave.state, 2), ignore_errors=True)
    assert slave.ask("put_back") == {"active": True}


def test_a_restored_process_that_ended_at_once_is_not_put_back(slave, counter):
    """A process that ends right after its restore is not restored a second time."""
    checkpointed(slave, counter)
    slave.ask("take")
    restored = slave.shim()
    eventually(lambda: restore_result.read(incoming(slave.state, 2)), "the restore")
    os.kill(process_tree.root_of(restored.pid), signal.SIGKILL)
    restored.process.wait(TIMEOUT)
    assert slave.ask("put_back") == {"active": True}
    nothing_left(slave)


def test_that_it_was_restored_is_known_as_long_as_its_image_is_kept(slave, counter):
    """A sweep keeps the result of a used image, so that a late `take` does not copy it again."""
    checkpointed(slave, counter)
    slave.ask("take")
    restored = slave.shim()
    eventually(lambda: restore_result.read(incoming(slave.state, 2)), "the restore")
    slave.end(restored)
    artifacts.sweep(slave.state, [])
    assert slave.ask("take") == {"taken": True}
    assert not (incoming(slave.state, 2) / image.MANIFEST).exists()
    assert slave.ask("put_back") == {"active": True}
    artifacts.sweep(slave.state, [])
    assert not incoming(slave.state, 2).exists()


def test_an_image_is_removed_whose_instance_ends_after_a_sweep(slave, counter, monkeypatch):
    """A killed slave leaves an image whose instance its successor finds, and which then ends."""
    monkeypatch.setattr(artifacts, "_LEFT_BEHIND", 0.1)
    checkpointed(slave, counter)
    slave.ask("take")
    artifacts.sweep(slave.state, ["counter#2"])
    eventually(lambda: not incoming(slave.state, 2).exists(), "the removal of the image")
    steps.drop({"numbers": [1], "here": {"state": str(slave.state)}})
    nothing_left(slave)


def test_a_slave_that_was_started_again_keeps_the_ports(slave, counter):
    """A restarted slave reserves the ports of checkpointed processes; a drop releases them."""
    checkpointed(slave, counter)
    port = port_of(counter)
    for one in steps._reserved.pop(1):
        one.close()
    assert is_free(port)
    steps.reserve_all(slave.state)
    assert not is_free(port)
    steps.drop({"numbers": [1, 9], "here": {"state": str(slave.state)}})
    assert is_free(port)
    nothing_left(slave)


def test_without_an_image_nothing_is_restored(slave, counter):
    """A missing image fails the restore, and its undo has no effect."""
    checkpointed(slave, counter)
    shutil.rmtree(checkpoint(slave.state, 1))
    with pytest.raises(CriuError, match="holds no complete image"):
        slave.ask("take")
    assert slave.ask("put_back") == {}
    checkpoint_ports(slave.state, 1).unlink()
    steps.drop({"numbers": [1], "here": {"state": str(slave.state)}})


def test_shared_memory_of_fast_dds_is_refused(slave, theatre):
    """Shared memory of Fast DDS, which peers would remove, is refused; the error has a remedy."""
    path = Path("/dev/shm/fastrtps_rosrm_test")
    path.write_bytes(b"\0" * 4096)
    code = (
        f"import mmap\nfile = open({str(path)!r}, 'r+b')\nheld = mmap.mmap(file.fileno(), 4096)\n"
        + COUNTER
    )
    actor = theatre.start(code)
    try:
        actor.counts()
    finally:
        path.unlink()
    slave.pids["p#1"] = actor.pid
    with pytest.raises(CriuError, match="FASTDDS_BUILTIN_TRANSPORTS: UDPv4"):
        slave.ask("keep", destination=40)
    actor.counts()
