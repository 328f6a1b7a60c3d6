"""A look that fails for want of a descriptor or memory tells nothing about a process or file."""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import os
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

from rosrm_criu.control import client
from rosrm_criu.control.messages import (
    SIGNAL,
    VARIABLE,
    Request,
    State,
    Status,
    Want,
    read_message,
    write_message,
)
from rosrm_criu.engine import (
    external_resources,
    image,
    open_files,
    paths,
    process_tree,
    restart_from_image,
    restore,
    restore_result,
    shim,
    slots,
    udp_ports,
)
from rosrm_criu.engine.restore_result import Outcome
from rosrm_criu.executors import artifacts, checkpoint, move, periodic

RESTORED = Outcome(pid=7, inner_pid=7)


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    """Yield a process that sleeps."""
    with subprocess.Popen(["sleep", "100"]) as process:
        yield process
        process.kill()


@pytest.fixture
def fails(monkeypatch):
    """Return a function that makes the next opens of a file fail."""
    really = io.open

    def fail(path: Path, *, times: int = 1, number: int = errno.EMFILE) -> None:
        calls = count()

        def opening(file, *rest, **named):
            if str(file) == str(path) and next(calls) < times:
                raise OSError(number, os.strerror(number), str(path))
            return really(file, *rest, **named)

        for module in (io, builtins):
            monkeypatch.setattr(module, "open", opening)

    return fail


# --- the result of a restore --------------------------------------------------------------------


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Return the result of a restore that succeeded; its image is removed."""
    directory = paths.incoming(tmp_path, 2)
    directory.mkdir(mode=0o700, parents=True)
    restore_result.write(directory, RESTORED)
    return directory / restore_result.FILE


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO, errno.EACCES])
def test_a_result_that_cannot_be_looked_at_is_none_of_any_kind(result, fails, number):
    fails(result, number=number)
    with pytest.raises(OSError, match=os.strerror(number)):
        restore_result.was_restored(result.parent)
    assert restore_result.was_restored(result.parent)


def test_a_wait_for_a_result_looks_again(result, fails):
    fails(result, times=3)
    assert restore_result.wait(result.parent, timeout=20.0, ended=lambda: True) == RESTORED
    fails(result, times=1_000_000)
    with pytest.raises(OSError, match="Too many open files"):
        restore_result.wait(result.parent, timeout=0.05, ended=lambda: True)


@pytest.mark.parametrize("times", [1, 1_000_000])
def test_a_restored_process_is_not_killed(result, fails, tmp_path, sleeper, times):
    """Unless its result is seen, neither the process nor the checkpoint is given up."""
    kept = paths.checkpoint(tmp_path, 1)
    image.create(kept)
    asked = {
        "here": {
            "host": "a", "state": str(tmp_path), "pids": {"x#2": sleeper.pid},
            "instances": ["x#2"], "options": {},
        },
        "process": "x", "source": 1, "destination": 2, "attempt": "t", "timeout": 0.1,
    }  # fmt: skip
    fails(result, times=times)
    if times > 1:
        with pytest.raises(OSError, match="Too many open files"):
            checkpoint.put_back(asked)
        assert kept.exists()
        fails(result, times=0)
    assert checkpoint.put_back(asked) == {"active": True}
    assert process_tree.is_alive(sleeper.pid)
    assert restore_result.read(result.parent) == RESTORED


def test_a_restart_does_not_lose_the_result(result, fails, monkeypatch, capsys):
    """The restart policy starts the shim again, which then runs the command."""
    words = restore_result.command(
        sys.executable, result.parent, criu=Path("/none"), remove=True, timeout=5.0,
        then=("echo", "started"),
    )  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["shim.py", *words[5:]])
    fails(result, number=errno.ENFILE)
    with pytest.raises(SystemExit) as ended:
        shim.main()
    assert ended.value.code == shim.FAILED
    assert "Too many open files in system" in capsys.readouterr().err
    again = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert again.stdout == "started\n"


def test_a_result_is_kept_until_it_was_seen(result, fails, monkeypatch):
    later = []
    monkeypatch.setattr(artifacts, "call_later", lambda *call: later.append(call))
    for remove in (artifacts.remove_unused, lambda one: artifacts._remove_if_idle(one, 1.0)):
        fails(result)
        if remove is artifacts.remove_unused:
            with pytest.raises(OSError, match="Too many open files"):
                remove(result.parent)
        else:
            remove(result.parent)
        assert restore_result.read(result.parent) == RESTORED
    assert [do for _, do, *_ in later] == [artifacts._remove_if_idle]


@pytest.mark.parametrize("name", [restore_result.FILE, "of"])
def test_a_sweep_keeps_a_result_that_it_cannot_look_at(result, fails, tmp_path, name):
    """While its checkpoint is kept, the result tells that the image was used."""
    image.create(paths.checkpoint(tmp_path, 1))
    artifacts.note_origin(result.parent, 1)
    fails(result.parent / name)
    artifacts.forget_restored(tmp_path, [])
    assert restore_result.was_restored(result.parent)


# --- a node that is out of the ROS graph ----------------------------------------------------------


@pytest.fixture
def away(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """Yield pid and control directory of a node that has left the ROS graph."""
    control = tmp_path / "control"
    control.mkdir(mode=0o700)
    write_message(control, Status(State.LEFT, "t"))
    program = f"import signal; signal.signal({SIGNAL}, lambda *_: None); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env={**os.environ, VARIABLE: str(control)},
    ) as node:  # fmt: skip
        assert node.stdout is not None
        assert node.stdout.readline()
        yield node.pid, control
        node.kill()


@pytest.mark.parametrize("name", ["status", "environ"])
def test_an_unexamined_node_is_not_left_out_of_the_graph(away, fails, tmp_path, name):
    """The undo of a move fails, so that it is repeated, and the note of the departure stays."""
    pid, control = away
    asked = {
        "here": {
            "host": "a", "state": str(tmp_path), "pids": {"x#1": pid}, "instances": ["x#1"],
            "options": {},
        },
        "process": "x", "source": 1, "destination": 2, "attempt": "t", "timeout": 0.1,
    }  # fmt: skip
    note = paths.periodic(tmp_path, 1) / "away"
    note.parent.mkdir(parents=True)
    note.write_text("t")
    for undo in (lambda: move.go_on(asked), lambda: periodic.call_back_all(tmp_path, {"x#1": pid})):
        fails(Path(f"/proc/{pid}/{name}"))
        with pytest.raises(OSError, match="Too many open files"):
            undo()
        assert note.exists()
    periodic.call_back_all(tmp_path, {"x#1": pid})
    assert read_message(control, Request) == Request("t", Want.JOIN)
    assert not note.exists()


# --- what a process has open ----------------------------------------------------------------------


@contextlib.contextmanager
def no_free_descriptor() -> Iterator[None]:
    """Let no file be opened in this context."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    "look",
    [
        lambda pid: list(open_files.descriptors([pid])),
        lambda pid: external_resources.outward([pid]),
        external_resources.tracer,
        lambda pid: external_resources.shared_memory([pid]),
        lambda _: external_resources._unix_peers(),
        lambda pid: udp_ports.bound([pid]),
        lambda pid: list(udp_ports._table(pid, "udp", socket.AF_INET)),
        lambda _: udp_ports.reserve([udp_ports.Port(socket.AF_INET, "127.0.0.1", 0)]),
        lambda _: udp_ports.read(Path(__file__)),
        process_tree.is_gone,
        lambda pid: process_tree.memory_of([pid]),
        lambda pid: restore.replace_marks(pid, {}),
    ],
)
def test_a_look_without_a_descriptor_does_not_say_nothing(sleeper, look):
    with no_free_descriptor(), pytest.raises(OSError, match="Too many open files"):
        look(sleeper.pid)


# --- the start from a periodic image --------------------------------------------------------------


@pytest.fixture
def slot(tmp_path: Path) -> Path:
    """Return a valid periodic image."""
    found = paths.periodic(tmp_path, 1) / "1"
    found.mkdir(parents=True)
    slots.complete(found, slots.Rejoin(str(tmp_path / "control"), "t", os.geteuid()))
    return found


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EMFILE])
@pytest.mark.parametrize("name", ["rejoin.json", "starts"])
def test_a_start_without_room_does_not_forgo_the_memory(
    slot, fails, monkeypatch, capsys, number, name
):
    """The restart policy tries again; the process does not start without its memory."""
    words = restart_from_image.command(
        sys.executable, slot.parent, ["false"], criu=Path("/none"), timeout=5.0
    )
    monkeypatch.setattr(sys, "argv", ["restart_from_image.py", *words[5:]])
    became = []
    monkeypatch.setattr(restart_from_image, "become", became.append)
    fails(slot / name, number=number)
    with pytest.raises(SystemExit, match=f"not started: .*{os.strerror(number)}"):
        restart_from_image.main()
    assert not became
    restart_from_image.main()
    assert any(word.endswith("shim.py") for word in became[0])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EMFILE])
def test_a_request_to_rejoin_without_room_does_not_forgo_the_memory(slot, monkeypatch, number):
    def refused(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(client, "write_message", refused)
    words = restart_from_image.command(
        sys.executable, slot.parent, ["false"], criu=Path("/none"), timeout=5.0
    )
    monkeypatch.setattr(sys, "argv", ["restart_from_image.py", *words[5:]])
    monkeypatch.setattr(restart_from_image, "become", lambda _: pytest.fail("it was started"))
    for _ in range(3):  # more often than an image is started from
        with pytest.raises(SystemExit, match=f"not started: .*{os.strerror(number)}"):
            restart_from_image.main()
