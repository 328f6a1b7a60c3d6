"""What a slave does for periodic checkpoints by `criu`: each function is an executor.

The node leaves the ROS graph, is dumped, and joins again at once. An image counts as soon as the
node has joined after it; until then there is the one before. Whoever is killed meanwhile, the next
slave has the node join again.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from rosrm.errors import CriuError
from rosrm_criu.control import await_joined
from rosrm_criu.engine import dump as dumping
from rosrm_criu.engine import external_resources, image, paths, process_tree, slots
from rosrm_criu.engine.binary import find
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.slots import Rejoin
from rosrm_criu.executors import artifacts
from rosrm_criu.executors.freeze import call_back, control_of, has_failed, leave, owner_of
from rosrm_criu.executors.request import Asked, without_log_names

#: Below the images of an instance: holds the id of its absence, as long as it is away.
_AWAY: Final = "away"
#: Seconds for a dump to end that a killed slave has begun, and between two looks at it.
_PATIENCE: Final = 20.0
_LOOK: Final = 0.01


def dump(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Have the node leave, dump it, and have it join again."""
    asked = Asked.of(arguments)
    parent = paths.periodic(asked.state, asked.source)
    with artifacts.alone(asked.source, asked.timeout):
        try:
            return _dump(asked, parent)
        except OSError as error:
            raise CriuError(why_not_written(parent, error)) from None


def why_not_written(parent: Path, error: OSError) -> str:
    """In words: a process that was started anew meanwhile has taken its images away."""
    if isinstance(error, FileNotFoundError) and not parent.exists():
        return "the process was started anew meanwhile, and its images are removed"
    return f"no image can be made in {parent}: {error.strerror}"


def _dump(asked: Asked, parent: Path) -> Mapping[str, Any]:
    pid = asked.leader(asked.source)
    control, root = control_of(pid), process_tree.root_of(pid)
    for directory in (parent.parent, parent):
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    slots.discard_unfinished(parent)
    slot, away, began = slots.new_slot(parent), parent / _AWAY, time.monotonic()
    away.write_text(asked.attempt, encoding="utf-8")
    try:
        manifest, left = _dump_away(asked, pid, control, slot)
        dumped = time.monotonic()
        status = await_joined(control, asked.attempt, _seconds(asked, "join"), root)
        joined = time.monotonic()
        _add_checksums(slot, manifest)
    except BaseException:  # whatever it was: the image is of no use
        shutil.rmtree(slot, ignore_errors=True)
        if has_failed(control):  # it can never join: its policy goes on, from the image before
            dumping.kill(pid)
        raise
    finally:
        away.unlink(missing_ok=True)
    slots.complete(slot, Rejoin(str(control), asked.attempt, owner_of(pid)))
    return {
        "size": manifest.size, "missing": list(status.missing),
        "seconds": {
            "prepare": left - began, "dump": dumped - left, "join": joined - dumped,
        },
    }  # fmt: skip


def _dump_away(asked: Asked, pid: int, control: Path, slot: Path) -> tuple[Manifest, float]:
    """The dump, and when the node had left for it; whatever fails, it is called back."""
    try:
        leave(pid, control, asked.attempt, _seconds(asked, "leave"))
        left = time.monotonic()
        with without_log_names():
            manifest = dumping.dump(
                find(), pid, slot, leave="running", timeout=_seconds(asked, "dump"),
                process=asked.process, instance=asked.source, checksums=False,
            )  # fmt: skip
    finally:
        call_back(pid, control, asked.attempt)
    return manifest, left


def _add_checksums(slot: Path, manifest: Manifest) -> None:
    """It reads the whole image: nobody is away for that."""
    checksums = image.file_checksums(slot, manifest.sizes)
    image.write(slot, replace(manifest, checksums=checksums))


def _seconds(asked: Asked, part: str) -> float:
    return float(asked.arguments["seconds"][part])


# --- what is left over ------------------------------------------------------------------------


def sweep(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Remove the images of instances that have ended."""
    here = arguments["here"]
    state, living = Path(here["state"]), set(map(artifacts.number_of, here["instances"]))
    for number in paths.periodic_numbers(state):
        if number not in living:
            artifacts.discard(paths.periodic(state, number))
    return {}


def call_back_all(state: Path, pids: Mapping[str, int]) -> None:
    """Whom a former slave has left away from the ROS graph joins again.

    Args:
        state: directory of the slave.
        pids: of the leaders of the instances that run here, by `process#number`.

    Raises:
        CriuError: one of them is still being dumped.
    """
    for instance, pid in pids.items():
        number = artifacts.number_of(instance)
        away = paths.periodic(state, number) / _AWAY
        if away.exists() and not artifacts.is_busy(number):
            _await_end_of_dump(instance, pid)
            call_back(pid, control_of(pid), away.read_text(encoding="utf-8"))
            away.unlink()


def _await_end_of_dump(instance: str, pid: int) -> None:
    """CRIU goes on without the slave that began it, and in the end stops what it has dumped."""
    deadline = time.monotonic() + _PATIENCE
    while tracer := external_resources.tracer(process_tree.root_of(pid)):
        if time.monotonic() > deadline:
            raise CriuError(
                f"{instance} is still being dumped after {_PATIENCE:g} s, by process {tracer}"
            )
        time.sleep(_LOOK)
