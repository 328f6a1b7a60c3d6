"""Failed dumps and restores: the process runs on, and its files stay as they were."""

from __future__ import annotations

import contextlib
import errno
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import dump, image, process_tree, put_back, udp_ports
from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.image import HeldFile
from rosrm_criu.executors import artifacts, checkpoint, move, periodic

#: Stops the process like `criu dump --leave-stopped`, and writes nothing.
STOP = '#!/bin/sh\nkill -STOP "$3"\n'


@pytest.fixture
def criu(tmp_path):
    program = tmp_path / "criu"
    program.write_text(STOP)
    program.chmod(0o700)
    return CriuBinary((str(program),), "4.2.1")


@pytest.fixture
def process():
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as running:
        yield running
        running.kill()


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def full_first(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "the first error")


def here(state: Path, instance: str, pid: int) -> dict[str, object]:
    return {
        "process": "p", "source": 1, "destination": 2, "attempt": "a", "timeout": 5.0,
        "seconds": {"leave": 1.0, "dump": 1.0},
        "here": {
            "host": "h", "state": str(state), "pids": {instance: pid}, "instances": [instance],
        },
    }  # fmt: skip


# --- engine -----------------------------------------------------------------------------------


def test_a_process_runs_on_before_its_useless_image_is_removed(
    tmp_path, criu, process, monkeypatch
):
    """The removal of gigabytes takes a while, and may fail."""
    stopped: list[bool] = []

    def remove(*_: object, **__: object) -> None:
        stopped.append(process_tree.is_stopped(process.pid))
        full()

    monkeypatch.setattr(image, "write", full)
    monkeypatch.setattr(image, "remove", remove)
    with pytest.raises(CriuError, match="cannot be written: No space left"):
        dump.dump(criu, process.pid, tmp_path / "image", leave="stopped", timeout=5.0)
    assert stopped == [False]


@pytest.mark.parametrize("again", [True, False])
def test_a_second_dump_has_the_rest_of_the_timeout(tmp_path, criu, process, monkeypatch, again):
    """With less than half of it, no second dump begins: a killed CRIU can harm the process."""
    seconds = 0.2 if again else 1.2
    timeouts: list[float] = []

    def run(*_: object, timeout: float, **__: object) -> None:
        timeouts.append(timeout)
        process.send_signal(signal.SIGSTOP)

    def receive(run: Callable[[int], None], _: Path) -> None:
        run(2)
        dump.resume(process.pid)
        time.sleep(seconds)

    monkeypatch.setattr(CriuBinary, "run", run)
    too_late = pytest.raises(CriuError, match="could not be received")
    with contextlib.nullcontext() if again else too_late:
        dump.dump(
            criu, process.pid, tmp_path / "image", leave="stopped", timeout=20.0 if again else 2.0,
            checksums=False, receive=receive,
        )  # fmt: skip
    assert len(timeouts) == (2 if again else 1)
    assert timeouts[-1] < timeouts[0] - seconds or not again
    assert process_tree.is_stopped(process.pid) is again


def test_a_file_that_cannot_be_put_back_leaves_nothing(tmp_path, monkeypatch):
    """The file of the process stays as it was, and no part of the copy lies beside it."""
    copy, work = tmp_path / "files" / "0", tmp_path / "work"
    copy.parent.mkdir()
    work.mkdir()
    copy.write_text("from the image")
    (work / "data").write_text("before")
    held = HeldFile(str(work / "data"), 14, 0o600, False, "files/0")
    monkeypatch.setattr(put_back.shutil, "copyfileobj", full)
    with pytest.raises(OSError, match="No space left"):
        put_back._put_back(tmp_path, held, str(work))
    assert [path.name for path in work.iterdir()] == ["data"]
    assert (work / "data").read_text() == "before"


# --- executors --------------------------------------------------------------------------------


def test_a_checkpoint_without_its_ports_lets_the_process_run_on(
    tmp_path, criu, process, monkeypatch
):
    """The ports cannot be written, and the image cannot be removed either."""
    stopped: list[bool] = []

    def discard(*_: object) -> None:
        stopped.append(process_tree.is_stopped(process.pid))
        full()

    monkeypatch.setattr(checkpoint, "find", lambda: criu)
    monkeypatch.setattr(udp_ports, "write", full_first)
    monkeypatch.setattr(checkpoint, "_discard", discard)
    with pytest.raises(OSError, match="the first error"):
        checkpoint.keep(here(tmp_path, "p#1", process.pid))
    assert stopped == [False]
    assert not process_tree.is_stopped(process.pid)


def test_an_undone_checkpoint_lets_the_process_run_on(tmp_path, process, monkeypatch):
    """The image of the checkpoint cannot be removed."""
    process.send_signal(signal.SIGSTOP)
    assert process_tree.wait_until_stopped([process.pid], 5.0)
    monkeypatch.setattr(checkpoint, "_discard", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.run_on({**here(tmp_path, "p#1", process.pid), "attempt": "undone"})
    assert not process_tree.is_stopped(process.pid)


@pytest.mark.parametrize("trouble", ["", "call_back"])
def test_a_failed_dump_calls_the_node_back_first(tmp_path, process, monkeypatch, trouble):
    """The end of the sender takes a while; it ends although the node cannot be called back."""
    done: list[str] = []

    def note(name: str) -> object:
        def call(*_: object) -> None:
            done.append(name)
            if name == trouble:
                full()

        return call

    monkeypatch.setattr(move, "control_of", lambda _: tmp_path)
    monkeypatch.setattr(artifacts, "open_sender", full_first)
    monkeypatch.setattr(move, "call_back", note("call_back"))
    monkeypatch.setattr(artifacts, "withdraw", note("withdraw"))
    with pytest.raises(OSError, match="the first error"):
        move.checkpoint({**here(tmp_path, "p#1", process.pid), "attempt": f"failed {trouble}"})
    assert done == ["call_back", "withdraw"]


@pytest.mark.parametrize("is_called_back", [True, False])
def test_a_node_that_was_not_called_back_stays_noted(
    tmp_path, process, monkeypatch, is_called_back
):
    """The request to rejoin cannot be written; the next slave repeats it."""

    def call_back(*_: object) -> None:
        if not is_called_back:
            full()

    monkeypatch.setattr(periodic, "control_of", lambda _: tmp_path / "control")
    monkeypatch.setattr(periodic, "leave", full_first)
    monkeypatch.setattr(periodic, "call_back", call_back)
    with pytest.raises(CriuError, match="the first error"):
        periodic.dump(here(tmp_path, "p#1", process.pid))
    away = tmp_path / "images" / "periodic-1" / "away"
    assert away.exists() is not is_called_back


def test_a_process_that_ended_since_costs_no_host_its_capability(tmp_path):
    """A slave calls back the nodes that its predecessor left; one ends at this moment."""
    ended = subprocess.Popen(["true"])
    ended.wait()
    away = tmp_path / "images" / "periodic-1" / "away"
    away.parent.mkdir(parents=True)
    away.write_text("p#1-periodic-1")
    periodic.call_back_all(tmp_path, {"p#1": ended.pid})


def test_a_node_that_cannot_be_called_back_is_reported(tmp_path, process):
    """The process runs, and names no control directory."""
    away = tmp_path / "images" / "periodic-1" / "away"
    away.parent.mkdir(parents=True)
    away.write_text("p#1-periodic-1")
    with pytest.raises(CriuError, match="was not started to be moved by criu"):
        periodic.call_back_all(tmp_path, {"p#1": process.pid})


def test_without_a_further_thread_the_receiving_end_is_closed_at_once(monkeypatch, caplog):
    """The image was received; its use does not depend on the end of the transfer."""

    def refused(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    closed: list[float] = []

    def close() -> None:
        closed.append(0.0)

    monkeypatch.setattr(artifacts.threads.Thread, "start", refused)
    artifacts.close_soon(SimpleNamespace(close=close))
    artifacts.remove_unused_later(Path("image"), 60.0)
    assert closed == [0.0]
    assert "_remove_if_idle in 60 s: can't start new thread" in caplog.text


def test_a_node_that_cannot_be_called_back_leaves_no_other_one_away(tmp_path, process, monkeypatch):
    """The others rejoin; the check of the host fails, and is repeated."""
    called = []

    def call_back(instance: str, _pid: int) -> None:
        called.append(instance)
        if instance == "p#1":
            raise CriuError("p#1 is still being dumped")

    monkeypatch.setattr(periodic, "_await_end_of_dump", call_back)
    monkeypatch.setattr(periodic, "control_of", lambda _: tmp_path)
    monkeypatch.setattr(periodic, "call_back", lambda *_: True)
    for number in (1, 2):
        (tmp_path / "images" / f"periodic-{number}").mkdir(parents=True)
        (tmp_path / "images" / f"periodic-{number}" / "away").touch()
    with pytest.raises(CriuError, match="p#1"):
        periodic.call_back_all(tmp_path, {"p#1": process.pid, "p#2": process.pid})
    assert called == ["p#1", "p#2"]
    assert [path.parent.name for path in tmp_path.rglob("away")] == ["periodic-1"]
