"""Executors of a slave for checkpoints and their restores by `criu`.

Each may be called twice, like those of `move`. Images of checkpoints lie apart from those of
migrations. A restore uses up only a copy made of hard links. So the original image stays intact
after any failure until the process is restored.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import threading
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.runtime import durable
from rosrm.shortage import exists
from rosrm_criu.engine import (
    dump,
    external_resources,
    image,
    process_tree,
    restore_result,
    udp_ports,
)
from rosrm_criu.engine.binary import find
from rosrm_criu.engine.paths import checkpoint, checkpoint_ports, incoming, numbers
from rosrm_criu.executors import artifacts, attempts
from rosrm_criu.executors.request import StepArguments, undoing, without_log_names
from rosrm_criu.plans import KEEP, TAKE

#: Sockets that reserve the ports of checkpointed processes, by the number of the instance.
_reserved: Final[dict[int, list[socket.socket]]] = {}
_changing: Final = threading.Lock()
#: Seconds between two polls of a condition that causes no event.
_LOOK: Final = 0.005


# --- checkpoint -------------------------------------------------------------------------------


def keep(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Dump the process into an image; the process stays stopped."""
    asked = StepArguments.of(arguments)
    return attempts.once(KEEP, asked.attempt, lambda: _keep(asked))


def _keep(asked: StepArguments) -> Mapping[str, Any]:
    with attempts.alone(asked.source, asked.timeout):
        return _keep_alone(asked)


def _keep_alone(asked: StepArguments) -> Mapping[str, Any]:
    pid = asked.leader(asked.source)
    root = process_tree.root_of(pid)
    if process_tree.is_stopped(root):  # by an earlier call, whose slave was killed
        dump.resume(pid)
    pids = process_tree.tree(root)
    trouble = external_resources.shared_memory(pids)
    if trouble:
        raise CriuError(f"{asked.process} cannot be checkpointed: {trouble}")
    directory, began = checkpoint(asked.state, asked.source), clocks.boot_time()
    artifacts.discard(directory)
    attempts.check_wanted(asked.attempt)
    # After any error the process continues, and nothing is left behind.
    with undoing(partial(dump.resume, pid), lambda: _discard(asked.state, asked.source)):
        with without_log_names():
            manifest = dump.dump(
                find(), pid, directory, leave="stopped", timeout=asked.timeout,
                process=asked.process, instance=asked.source,
            )  # fmt: skip
        ports = checkpoint_ports(asked.state, asked.source)
        udp_ports.write(ports, udp_ports.bound(pids))
        # The process is killed next: only the image has its memory.
        for written in (directory, ports):
            durable.sync(str(written))
        durable.sync_directory(str(directory.parent))
    return {"size": manifest.size, "seconds": {"dump": clocks.boot_time() - began}}


def run_on(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Undo a failed checkpoint: continue the process, unless it has ended."""
    asked = StepArguments.of(arguments)
    attempts.turn_back(asked.attempt)
    attempts.after(KEEP, asked.attempt, asked.timeout)
    pid = asked.pid(asked.source)
    if pid:
        dump.resume(pid)
    _discard(asked.state, asked.source)
    return {}


def kill(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Kill the process after the commit, and reserve its ports for the image that owns the name."""
    asked = StepArguments.of(arguments)
    pid = asked.pid(asked.source)
    if pid:
        members = process_tree.tree(process_tree.root_of(pid))
        dump.kill(pid)
        deadline = clocks.boot_time() + asked.timeout
        while not all(map(process_tree.is_gone, members)):
            if clocks.boot_time() > deadline:
                raise CriuError(f"{asked.process}#{asked.source} does not end")
            time.sleep(_LOOK)
    _reserve(asked.state, asked.source)
    return {}


# --- restore ----------------------------------------------------------------------------------


def take(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Copy the image by hard links, for the start that follows."""
    asked = StepArguments.of(arguments)
    if asked.pid(asked.destination):
        return {"taken": True}  # an earlier call took it, and the restore is under way
    if restore_result.was_restored(incoming(asked.state, asked.destination)):
        return {"taken": True}  # restored once already; the process has ended since
    source, target = checkpoint(asked.state, asked.source), incoming(asked.state, asked.destination)
    image.read(source)
    artifacts.discard(target)
    artifacts.forget_restored(asked.state, asked.instances)
    try:
        target.mkdir(mode=0o700)
        shutil.copytree(source, target, copy_function=image.link_or_copy, dirs_exist_ok=True)
        artifacts.note_origin(target, asked.source)
    except (OSError, shutil.Error) as error:
        artifacts.discard(target)
        raise CriuError(f"the image {source} cannot be laid out as {target}: {error}") from None
    return {"taken": True}


def await_checkpoint(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Wait until the image is restored, and remove it."""
    asked = StepArguments.of(arguments)
    found = artifacts.await_restored(asked)
    _discard(asked.state, asked.source)
    return {"seconds": {"restore": found.seconds}}


def put_back(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Undo a restore: keep the original image, unless the process is already restored.

    A restore under way is awaited, because it must not be killed while it may succeed.

    Raises:
        CriuError: it has not succeeded in time, and is killed.
        OSError: no look at its result is possible now; nothing was changed.
    """
    asked = StepArguments.of(arguments)
    directory = incoming(asked.state, asked.destination)
    if not exists(directory):
        gone = not exists(checkpoint(asked.state, asked.source))
        return {"active": True} if gone and TAKE in asked.results else {}
    pid = asked.pid(asked.destination)
    try:
        artifacts.await_restored(asked)
    except CriuError:
        if asked.pid(asked.destination):
            process_tree.send([pid], signal.SIGKILL)  # the shim, and so the restored process
            raise
        artifacts.discard(directory)
        return {}
    _discard(asked.state, asked.source)
    return {"active": True}


# --- both -------------------------------------------------------------------------------------


def drop(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Remove images that are no longer needed."""
    state = Path(arguments["here"]["state"])
    for number in map(int, arguments["numbers"]):
        _discard(state, number)
        artifacts.discard(incoming(state, number))
    return {}


def reserve_all(state: Path) -> None:
    """Reserve the ports of all checkpointed processes again, after the start of a slave."""
    for number in numbers(state, "kept"):
        _reserve(state, number)


def _reserve(state: Path, number: int) -> None:
    with _changing:
        if number not in _reserved:
            _reserved[number] = udp_ports.reserve(udp_ports.read(checkpoint_ports(state, number)))


def _discard(state: Path, number: int) -> None:
    """Remove a checkpoint and release its ports."""
    artifacts.discard(checkpoint(state, number))
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        checkpoint_ports(state, number).unlink()
    with _changing:
        for one in _reserved.pop(number, ()):
            one.close()
