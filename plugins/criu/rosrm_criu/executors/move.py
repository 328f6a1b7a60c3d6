"""Executors of the slaves for migrations by `criu`: JSON in, JSON out.

Each may be called twice, because a restarted master repeats the current step, and so does a master
whose slave was restarted. `artifacts` has the state that is kept between the calls.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rosrm import clocks
from rosrm.errors import CriuError, PortableError
from rosrm.shortage import is_directory
from rosrm_criu.control.client import (
    ask_resume,
    await_joined,
    is_control_directory,
    make_directory,
)
from rosrm_criu.control.directory import remove_directory
from rosrm_criu.control.messages import State, Status, read_message
from rosrm_criu.engine import dump, process_tree, received
from rosrm_criu.engine.binary import find
from rosrm_criu.engine.image import PARENT
from rosrm_criu.engine.paths import incoming, outgoing
from rosrm_criu.engine.probe import criu_support
from rosrm_criu.executors import artifacts, attempts, periodic, precopy
from rosrm_criu.executors.attempts import Answer
from rosrm_criu.executors.checkpoint import reserve_all
from rosrm_criu.executors.freeze import call_back, control_of, has_failed, leave, owner_of
from rosrm_criu.executors.request import StepArguments, undoing, without_log_names
from rosrm_criu.plans import CHECKPOINT, FETCH, INTRODUCE
from rosrm_criu.transfer import Offer, Sender, missing


def report_capability(arguments: Answer) -> Answer:
    """Return the facts of this host that decide about restores; raise `CriuError` without CRIU.

    A slave gets this call after its registration, so the rest of its predecessor is removed here.
    """
    here = arguments["here"]
    state = Path(here["state"])
    artifacts.sweep(state, here["instances"])
    precopy.sweep(state)
    periodic.sweep(arguments)
    reserve_all(state)
    periodic.call_back_all(state, here["pids"])
    found = criu_support()
    if not found.works:
        raise CriuError(found.reason)
    return {
        **found.facts, "host": here["host"], "no_transfer": missing(),
        "takes_none": refusal_of_images(here),
    }  # fmt: skip


def refusal_of_images(here: Mapping[str, Any]) -> str:
    """Return the reason why this slave takes no image from another host; "": it takes them.

    CRIU restores the user that the image names, so its source could run any program as root here.
    """
    if os.geteuid() != 0 or here["options"].get("as_root") is True:
        return ""
    return (
        f"the slave of {here['host']} runs as root, and so takes no image of another host, which "
        "could run any program as root here. Run the slave as an ordinary user, or write "
        "`strategies: {criu: {as_root: true}}` in its host file"
    )


# --- the source -------------------------------------------------------------------------------


def checkpoint(arguments: Answer) -> Answer:
    """Make the node leave the ROS graph, dump it, and offer the image.

    The node is frozen from then on; after any failure it is asked to continue.
    """
    asked = StepArguments.of(arguments)
    return attempts.once(CHECKPOINT, asked.attempt, lambda: _checkpoint(asked))


def _checkpoint(asked: StepArguments) -> Answer:
    with attempts.alone(asked.source, asked.timeout):
        return _checkpoint_alone(asked)


def _checkpoint_alone(asked: StepArguments) -> Answer:
    pid = asked.leader(asked.source)
    control = control_of(pid)
    # Any error: the node rejoins, and afterwards the sender ends, because that takes a while.
    back = partial(call_back, pid, control, asked.attempt)
    with undoing(back, partial(artifacts.withdraw, asked.state, asked.source)):
        sender = artifacts.open_sender(asked.source)
        began = clocks.boot_time()
        left = leave(pid, control, asked.attempt, float(asked.arguments["seconds"]["leave"]))
        dumped = clocks.boot_time()
        directory, dump_part = _dump(pid, asked)
        offered = clocks.boot_time()
        offer = _offer(sender, directory, asked)
    return {
        "offer": offer.as_json(), "control": str(control), "uid": owner_of(pid), "size": offer.size,
        "seconds": {
            "prepare": dumped - began, "leave": left, dump_part: offered - dumped,
            "offer": clocks.boot_time() - offered,
        },
    }  # fmt: skip


def go_on(arguments: Answer) -> Answer:
    """Undo a failed migration: the node continues where it is frozen.

    If the node has ended since, its restart policy applies.
    """
    asked = StepArguments.of(arguments)
    attempts.turn_back(asked.attempt)
    attempts.after(CHECKPOINT, asked.attempt, asked.timeout)
    artifacts.withdraw(asked.state, asked.source)
    pid = asked.pid(asked.source)
    if not pid:
        return {"fault": "it has ended"}
    try:
        control = control_of(pid)
    except CriuError:  # for the same reason it was never asked to leave
        dump.resume(pid)
        return {}
    before = read_message(control, Status)
    if not call_back(pid, control, asked.attempt) or (before and before.state is State.RUNNING):
        return {}  # it had not left, and completes its current action
    status = await_joined(control, asked.attempt, asked.timeout, process_tree.root_of(pid))
    return {"missing": list(status.missing)}


def end(arguments: Answer) -> Answer:
    """Remove the rest of the source after the commit to the destination."""
    asked = StepArguments.of(arguments)
    artifacts.withdraw(asked.state, asked.source)
    pid = asked.pid(asked.source)
    if pid:
        control = control_of(pid)
        status = read_message(control, Status)
        dump.kill(pid)
        # If both hosts share the directory, its status already says that the node runs.
        if status is not None and status.state is State.LEFT:
            remove_directory(control)
    artifacts.call_later(0.0, precopy.remove_sent_copy, asked.state, asked.source)
    return {}


def _dump(pid: int, asked: StepArguments) -> tuple[Path, str]:
    """Dump the process; return the directory of the image, and the name of this part."""
    directory = outgoing(asked.state, asked.source)
    artifacts.discard(directory)
    attempts.check_wanted(asked.attempt)
    with without_log_names():
        manifest = dump.dump(
            find(), pid, directory, leave="stopped",
            timeout=float(asked.arguments["seconds"]["dump"]),
            process=asked.process, instance=asked.source, checksums=False,
            receive=precopy.receiver(asked),
        )  # fmt: skip
    is_compared = any(name.startswith(f"{PARENT}/") for name in manifest.sizes)
    return directory, "dump_compared" if is_compared else "dump"


def _offer(sender: Sender, directory: Path, asked: StepArguments) -> Offer:
    seconds = float(asked.arguments["seconds"]["offer"])
    attempts.check_wanted(asked.attempt)
    offer = sender.offer(
        directory, seconds=seconds, max_rate=float(asked.arguments["max_rate"]),
        to=str(asked.results[INTRODUCE]["certificate"]),
    )  # fmt: skip
    artifacts.remove_when_over(asked.state, asked.source, sender, seconds)
    return offer


# --- the destination --------------------------------------------------------------------------


def introduce(arguments: Answer) -> Answer:
    """Prepare the fetch before the node is frozen; return the only certificate that may fetch."""
    asked = StepArguments.of(arguments)
    if refusal := refusal_of_images(arguments["here"]):
        raise CriuError(refusal)
    named = arguments.get("working_directory")
    if named and not is_directory(Path(named).expanduser()):
        raise CriuError(f"its working directory {named} does not exist on {asked.host}: make it")
    certificate = artifacts.open_fetcher(asked.destination, float(arguments["keep"]))
    return {"certificate": certificate, "copy": precopy.received_fingerprint(asked)}


def fetch_image(arguments: Answer) -> Answer:
    """Fetch the image to this host, for the start that follows."""
    asked = StepArguments.of(arguments)
    return attempts.once(FETCH, asked.attempt, lambda: _fetch(asked))


def _fetch(asked: StepArguments) -> Answer:
    dumped = asked.results[CHECKPOINT]
    uid, control = int(dumped["uid"]), Path(dumped["control"])
    if not is_control_directory(control, uid):
        raise PortableError(f"{control} is no control directory of user {uid}")
    received.check_source(uid)
    directory = incoming(asked.state, asked.destination)
    artifacts.discard(directory)
    artifacts.forget_restored(asked.state, asked.instances)
    fetcher = artifacts.take_fetcher(asked.destination)
    if fetcher is None:
        raise CriuError(
            f"the slave of {asked.host} was started again in the midst of the move, or that took "
            f"too long, and the image is for the former end alone: ask for the move again"
        )
    try:
        fetched = fetcher.fetch(
            Offer.from_json(dumped["offer"]), directory, timeout=asked.timeout,
            reserve=int(asked.arguments["reserve"]),
        )  # fmt: skip
        precopy.put_in_place(asked, directory)
        _check_received(asked, directory, uid)
    finally:
        artifacts.close_soon(fetcher)
        artifacts.remove_unused_later(directory, float(asked.arguments["keep"]))
    make_directory(control, uid)
    return {"seconds": {"transfer": fetched.seconds}, "received": fetched.received}


def _check_received(asked: StepArguments, directory: Path, uid: int) -> None:
    """Remove an image that this host must not restore, and raise `CriuError`."""
    named = asked.arguments.get("working_directory")
    try:
        received.check(directory, state=asked.state, working_directory=named, uid=uid)
    except CriuError:
        artifacts.discard(directory)
        raise


def await_restored(arguments: Answer) -> Answer:
    """Wait until the image is restored; remove an image whose restore fails."""
    asked = StepArguments.of(arguments)
    try:
        found = artifacts.await_restored(asked)
    except CriuError:
        artifacts.remove_unused(incoming(asked.state, asked.destination))
        raise
    return {"seconds": {"restore": found.seconds}}


def join(arguments: Answer) -> Answer:
    """Make the node rejoin the ROS graph here; kill one that never can, for its restart policy."""
    asked = StepArguments.of(arguments)
    pid = asked.pid(asked.destination)
    root, began = process_tree.root_of(pid), clocks.boot_time()
    try:
        control = control_of(pid)
        ask_resume(control, root, asked.attempt)
        status = await_joined(control, asked.attempt, asked.timeout, root)
    except (CriuError, PortableError) as error:
        if not (process_tree.is_alive(root) and process_tree.is_alive(pid)):
            return {"fault": "it has ended"}
        if not has_failed(control_of(pid)):
            raise
        dump.kill(pid)
        return {"fault": str(error)}
    return {"seconds": _of_joining(status, began), "missing": list(status.missing)}


def _of_joining(status: Status, began: float) -> dict[str, float]:
    own = {f"node_{name}": value for name, value in status.seconds.items()}
    return {"join": clocks.boot_time() - began, **own}
