"""What the slaves do for `criu`: each function is an executor, given JSON and answering with it.

Every one may be asked for twice: a master that was killed gives the step in hand once more.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rosrm.criu import dumping, image, outcome, tree
from rosrm.criu.places import incoming, outgoing
from rosrm.criu.probe import ability
from rosrm.criu.program import find
from rosrm.errors import CriuError, PortableError
from rosrm.portable import (
    VARIABLE,
    State,
    ask_prepare,
    ask_resume,
    await_joined,
    await_left,
    control_root,
    make_directory,
    status_of,
)
from rosrm.transfer import Offer, Sender, fetch
from rosrm_migration.criu import CHECKPOINT

Answer = Mapping[str, Any]

#: What this host offers to others, by the number of the instance that an image is of.
_offers: Final[dict[int, Sender]] = {}
_changing: Final = threading.Lock()


def say_ability(_arguments: Answer) -> Answer:
    """Whether CRIU works here, and what an image of this host needs elsewhere."""
    found = ability()
    if not found.works:
        raise CriuError(found.reason)
    return dict(found.facts)


# --- the source -------------------------------------------------------------------------------


def checkpoint(arguments: Answer) -> Answer:
    """Have the node leave the ROS graph, dump it, and offer the image.

    It stands still from then on; whatever fails, it is asked to go on.
    """
    pid, control = _leader(arguments, "source"), None
    try:
        control = _control_of(pid)
        began = time.monotonic()
        left = _leave(pid, control, arguments)
        dumped = time.monotonic()
        directory = _dump(pid, arguments)
        offered = time.monotonic()
        offer = _offer(directory, arguments)
    except Exception:
        _go_on(pid, control, arguments)
        raise
    return {
        "offer": offer.as_json(), "control": str(control), "uid": _owner(pid), "size": offer.size,
        "seconds": {
            "prepare": dumped - began, "leave": left, "dump": offered - dumped,
            "offer": time.monotonic() - offered,
        },
    }  # fmt: skip


def go_on(arguments: Answer) -> Answer:
    """The move has failed: the node goes on where it stands still."""
    pid = _leader(arguments, "source")
    _go_on(pid, _control_of(pid), arguments)
    return {}


def end(arguments: Answer) -> Answer:
    """The destination owns the name: what is left of the source goes."""
    _withdraw(arguments)
    pid = _pids(arguments).get(_instance(arguments, "source"))
    if pid:
        dumping.kill(pid)
    return {}


def _leave(pid: int, control: Path, arguments: Answer) -> float:
    """Seconds that it took by the node's own word."""
    attempt, root = _attempt(arguments), tree.root_of(pid)
    if tree.is_stopped(root):  # an earlier asking of this very step has dumped it
        dumping.resume(pid)
    ask_prepare(control, root, attempt)
    status = await_left(control, attempt, float(arguments["seconds"]["leave"]), root)
    return status.seconds.get("leave", 0.0)


def _dump(pid: int, arguments: Answer) -> Path:
    directory = outgoing(_state(arguments), int(arguments["source"]))
    _withdraw(arguments)
    dumping.dump(
        find(), pid, directory, leave="stopped", timeout=float(arguments["seconds"]["dump"]),
        process=str(arguments["process"]), instance=int(arguments["source"]),
    )  # fmt: skip
    return directory


def _offer(directory: Path, arguments: Answer) -> Offer:
    seconds = float(arguments["seconds"]["offer"])
    sender = Sender()
    with _changing:
        _offers[int(arguments["source"])] = sender
    offer = sender.offer(directory, seconds=seconds, max_rate=float(arguments["max_rate"]))
    over = (sender, int(arguments["source"]), directory, seconds)
    threading.Thread(target=_remove_when_over, args=over, name="image", daemon=True).start()
    return offer


def _remove_when_over(sender: Sender, number: int, directory: Path, seconds: float) -> None:
    """Nobody fetches it any more, whether it was taken or its time has passed."""
    sender.wait(seconds + 5.0)
    with _changing:
        if _offers.get(number) is not sender:
            return  # withdrawn: there may be another image by now
        del _offers[number]
        image.remove(directory)


def _withdraw(arguments: Answer) -> None:
    """There is no offer any more, nor an image."""
    number = int(arguments["source"])
    with _changing:
        sender = _offers.pop(number, None)
    if sender is not None:
        sender.close()
    image.remove(outgoing(_state(arguments), number))


def _go_on(pid: int, control: Path | None, arguments: Answer) -> None:
    _withdraw(arguments)
    root = tree.root_of(pid)
    dumping.resume(pid)
    if control is not None:
        ask_resume(control, root, _attempt(arguments))
        await_joined(control, _attempt(arguments), float(arguments["timeout"]), root)


# --- the destination --------------------------------------------------------------------------


def fetch_image(arguments: Answer) -> Answer:
    """Bring the image here, for the start that follows."""
    told = arguments["results"][CHECKPOINT]
    control = Path(told["control"])
    if control.parent != control_root(int(told["uid"])):
        raise PortableError(f"{control} is no control directory of user {told['uid']}")
    directory = incoming(_state(arguments), int(arguments["destination"]))
    image.remove(directory)
    fetched = fetch(Offer.from_json(told["offer"]), directory, timeout=float(arguments["timeout"]))
    make_directory(control, int(told["uid"]))
    threading.Timer(float(arguments["keep"]), _remove_unused, [directory]).start()
    return {"seconds": {"transfer": fetched.seconds}, "received": fetched.received}


def _remove_unused(directory: Path) -> None:
    """It was fetched for nothing, unless a process was restored from it."""
    told = outcome.read(directory)
    if told is None or told.reason:
        image.remove(directory)


def await_restored(arguments: Answer) -> Answer:
    """Wait until the image is a process again."""
    pid = _leader(arguments, "destination")
    directory = incoming(_state(arguments), int(arguments["destination"]))
    found = outcome.wait(
        directory, timeout=float(arguments["timeout"]), ended=lambda: not tree.is_alive(pid)
    )
    return {"seconds": {"restore": found.seconds}}


def join(arguments: Answer) -> Answer:
    """Have the node join the ROS graph here; one that never can is ended: its policy goes on."""
    attempt, timeout = _attempt(arguments), float(arguments["timeout"])
    pid = _pids(arguments).get(_instance(arguments, "destination"), 0)
    if not pid or not tree.is_alive(pid):
        return {"fault": "it has ended"}
    root, began = tree.root_of(pid), time.monotonic()
    control = _control_of(pid)
    try:
        ask_resume(control, root, attempt)
        status = await_joined(control, attempt, timeout, root)
    except PortableError as error:
        found = status_of(control)
        if found is None or found.state is not State.FAILED:
            raise
        dumping.kill(pid)
        return {"fault": str(error)}
    seconds = {"join": time.monotonic() - began, **_rejoin(status.seconds)}
    return {"seconds": seconds, "missing": list(status.missing)}


def _rejoin(seconds: Mapping[str, float]) -> dict[str, float]:
    return {f"node_{name}": value for name, value in seconds.items()}


# --- both -------------------------------------------------------------------------------------


def _attempt(arguments: Answer) -> str:
    """Of this move, in what the node is asked: no other has this destination."""
    return f"{arguments['process']}#{arguments['source']}-{arguments['destination']}"


def _state(arguments: Answer) -> Path:
    return Path(arguments["here"]["state"])


def _instance(arguments: Answer, side: str) -> str:
    return f"{arguments['process']}#{arguments[side]}"


def _pids(arguments: Answer) -> Mapping[str, int]:
    pids: Mapping[str, int] = arguments["here"]["pids"]
    return pids


def _leader(arguments: Answer, side: str) -> int:
    """Pid of an instance; raises CriuError where it does not run here."""
    instance = _instance(arguments, side)
    pid = _pids(arguments).get(instance, 0)
    if not pid:
        raise CriuError(f"{instance} does not run on {arguments['here']['host']}")
    return pid


def _control_of(pid: int) -> Path:
    """Where the node is spoken to: it was told at its start, and keeps it through a move."""
    mark = f"{VARIABLE}=".encode()
    try:
        variables = Path(f"/proc/{tree.root_of(pid)}/environ").read_bytes().split(b"\0")
    except OSError as error:
        raise CriuError(f"process {pid} cannot be looked at: {error.strerror}") from None
    found = next((word[len(mark) :] for word in variables if word.startswith(mark)), b"")
    if not found:
        raise CriuError(
            f"process {pid} was not started to be moved by criu: restart it, with "
            f"`migration: criu` in its file"
        )
    return Path(os.fsdecode(found))


def _owner(pid: int) -> int:
    return Path(f"/proc/{tree.root_of(pid)}").stat().st_uid
