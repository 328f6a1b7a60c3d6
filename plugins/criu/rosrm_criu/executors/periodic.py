"""Executors of a slave for periodic checkpoints by `criu`.

The node leaves the ROS graph, is dumped, and rejoins at once. An image becomes valid as soon as the
node has rejoined after it; until then the previous one is valid. If the slave is killed on the way,
the next slave makes the node rejoin.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import CriuError, PortableError
from rosrm.shortage import exists
from rosrm.wording import reason_of
from rosrm_criu.control.client import await_joined
from rosrm_criu.engine import dump as dumping
from rosrm_criu.engine import external_resources, image, paths, process_tree, slots
from rosrm_criu.engine.binary import find
from rosrm_criu.engine.image import Manifest
from rosrm_criu.engine.slots import Rejoin
from rosrm_criu.executors import artifacts, attempts
from rosrm_criu.executors.freeze import call_back, control_of, has_failed, leave, owner_of
from rosrm_criu.executors.request import StepArguments, undoing, without_log_names

#: File beside the images of an instance, with the id of its departure while the node is away.
_AWAY: Final = "away"
#: Seconds for the end of a dump that a killed slave has begun, and between two polls of it.
_PATIENCE: Final = 20.0
_LOOK: Final = 0.01


def dump(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Make the node leave, dump it, and make it rejoin."""
    asked = StepArguments.of(arguments)
    parent = paths.periodic(asked.state, asked.source)
    with attempts.alone(asked.source, asked.timeout):
        try:
            return _dump(asked, parent)
        except OSError as error:
            raise CriuError(why_not_written(parent, error)) from None


def why_not_written(parent: Path, error: OSError) -> str:
    """Explain a failed write; the images are missing if the process was restarted since."""
    if isinstance(error, FileNotFoundError) and not exists(parent):
        return "the process was restarted during the checkpoint, which removed its images"
    return f"no image can be made in {parent}: {reason_of(error)}"


def _dump(asked: StepArguments, parent: Path) -> Mapping[str, Any]:
    pid = asked.leader(asked.source)
    control, root = control_of(pid), process_tree.root_of(pid)
    for directory in (parent.parent, parent):
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    slots.discard_unfinished(parent)
    slot, began = slots.new_slot(parent), clocks.boot_time()
    (parent / _AWAY).write_text(asked.attempt, encoding="utf-8")

    def discard() -> None:
        shutil.rmtree(slot, ignore_errors=True)
        if has_failed(control):  # its restart policy starts it from the previous image
            dumping.kill(pid)

    with undoing(discard):  # after any error the image is useless
        manifest, left = _dump_away(asked, pid, control, slot)
        dumped = clocks.boot_time()
        status = await_joined(control, asked.attempt, _seconds(asked, "join"), root)
        joined = clocks.boot_time()
        _add_checksums(slot, manifest)
    slots.complete(slot, Rejoin(str(control), asked.attempt, owner_of(pid)))
    return {
        "size": manifest.size, "missing": list(status.missing),
        "seconds": {
            "prepare": left - began, "dump": dumped - left, "join": joined - dumped,
        },
    }  # fmt: skip


def _dump_away(asked: StepArguments, pid: int, control: Path, slot: Path) -> tuple[Manifest, float]:
    """Dump the node; return the manifest and the time of departure. The node always rejoins."""

    def back() -> None:
        call_back(pid, control, asked.attempt)
        (slot.parent / _AWAY).unlink(missing_ok=True)

    with undoing(back):
        leave(pid, control, asked.attempt, _seconds(asked, "leave"))
        left = clocks.boot_time()
        with without_log_names():
            manifest = dumping.dump(
                find(), pid, slot, leave="running", timeout=_seconds(asked, "dump"),
                process=asked.process, instance=asked.source, checksums=False,
            )  # fmt: skip
    back()
    return manifest, left


def _add_checksums(slot: Path, manifest: Manifest) -> None:
    """Add checksums while the node runs again, because this reads the whole image."""
    checksums = image.file_checksums(slot, manifest.sizes)
    image.write(slot, replace(manifest, checksums=checksums))


def _seconds(asked: StepArguments, part: str) -> float:
    return float(asked.arguments["seconds"][part])


# --- what is left over ------------------------------------------------------------------------


def sweep(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Remove the images of instances that have ended."""
    here = arguments["here"]
    state, present = Path(here["state"]), set(map(artifacts.number_of, here["instances"]))
    for number in paths.numbers(state, "periodic"):
        if number not in present:
            artifacts.discard(paths.periodic(state, number))
    return {}


def call_back_all(state: Path, pids: Mapping[str, int]) -> None:
    """Request a rejoin from the nodes that a former slave has left out of the ROS graph.

    Args:
        state: directory of the slave.
        pids: leaders of the instances that run here, by `process#number`.

    Raises:
        CriuError, PortableError: one of them is still being dumped, or cannot be called back; all
            others have been.
    """
    faults: list[Exception] = []
    for instance, pid in pids.items():
        number = artifacts.number_of(instance)
        away = paths.periodic(state, number) / _AWAY
        if not exists(away) or attempts.is_busy(number):
            continue
        try:
            _await_end_of_dump(instance, pid)
            call_back(pid, control_of(pid), away.read_text(encoding="utf-8"))
        except (CriuError, PortableError, OSError) as fault:
            if process_tree.is_alive(pid):
                faults.append(fault)
                continue
        away.unlink(missing_ok=True)
    if faults:
        raise faults[0]


def _await_end_of_dump(instance: str, pid: int) -> None:
    """Wait for a CRIU that outlived its slave, because it stops the process when it finishes."""
    deadline = clocks.boot_time() + _PATIENCE
    while tracer := external_resources.tracer(process_tree.root_of(pid)):
        if clocks.boot_time() > deadline:
            raise CriuError(
                f"{instance} is still being dumped after {_PATIENCE:g} s, by process {tracer}"
            )
        time.sleep(_LOOK)
