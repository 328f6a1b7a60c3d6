"""What the slaves do for `criu`: each function is an executor, given JSON and answering with it.

Every one may be asked for twice: a master that was killed gives the step in hand once more, and so
does one whose slave was started again. `criu_luggage` has what is kept from one to the next.
"""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rosrm.criu import dumping, outcome, tree
from rosrm.criu.places import incoming, outgoing
from rosrm.criu.probe import ability
from rosrm.criu.program import find
from rosrm.errors import CriuError, PortableError
from rosrm.portable import (
    VARIABLE,
    State,
    Status,
    ask_prepare,
    ask_resume,
    await_joined,
    await_left,
    control_directory,
    make_directory,
    remove_directory,
    status_of,
)
from rosrm.transfer import Offer, Sender
from rosrm_migration import criu_luggage as luggage
from rosrm_migration.criu import CHECKPOINT, FETCH, INTRODUCE
from rosrm_migration.criu_kept_steps import reserve_all
from rosrm_migration.criu_luggage import Answer

#: Attempts that were turned back: a checkpoint under way for one goes no further.
_turned_back: Final[set[str]] = set()
_turning: Final = threading.Lock()
#: CRIU's logs go with the image; what matters of them is in the message.
_LOG: Final = re.compile(r" \((its )?log: [^)]*\)")


def say_ability(arguments: Answer) -> Answer:
    """Whether CRIU works here, and what an image of this host needs elsewhere.

    A slave is asked for it when it has registered: what one before it has left, goes.
    """
    luggage.sweep(_state(arguments), _pids(arguments))
    reserve_all(_state(arguments))
    found = ability()
    if not found.works:
        raise CriuError(found.reason)
    return dict(found.facts)


# --- the source -------------------------------------------------------------------------------


def checkpoint(arguments: Answer) -> Answer:
    """Have the node leave the ROS graph, dump it, and offer the image.

    It stands still from then on; whatever fails, it is asked to go on.
    """
    return luggage.once(CHECKPOINT, _attempt(arguments), lambda: _checkpoint(arguments))


def _checkpoint(arguments: Answer) -> Answer:
    pid = _leader(arguments, "source")
    control = _control_of(pid)
    try:
        sender = luggage.open_sender(int(arguments["source"]))
        began = time.monotonic()
        left = _leave(pid, control, arguments)
        dumped = time.monotonic()
        directory = _dump(pid, arguments)
        offered = time.monotonic()
        offer = _offer(sender, directory, arguments)
    except Exception:
        _call_back(pid, control, arguments)
        raise
    return {
        "offer": offer.as_json(), "control": str(control), "uid": _owner(pid), "size": offer.size,
        "seconds": {
            "prepare": dumped - began, "leave": left, "dump": offered - dumped,
            "offer": time.monotonic() - offered,
        },
    }  # fmt: skip


def go_on(arguments: Answer) -> Answer:
    """The move has failed: the node goes on where it stands still.

    One that has ended meanwhile does not: its restart policy says what follows.
    """
    attempt, timeout = _attempt(arguments), float(arguments["timeout"])
    with _turning:
        _turned_back.add(attempt)
    luggage.after(CHECKPOINT, attempt, timeout)
    pid = _pids(arguments).get(_instance(arguments, "source"), 0)
    if not pid or not tree.is_alive(pid):
        luggage.withdraw(_state(arguments), int(arguments["source"]))
        return {"fault": "it has ended"}
    control = _control_of(pid)
    before = status_of(control)
    if not _call_back(pid, control, arguments) or (before and before.state is State.RUNNING):
        return {}  # it had not left: what it does just now, it does to its end
    status = await_joined(control, attempt, timeout, tree.root_of(pid))
    return {"missing": list(status.missing)}


def end(arguments: Answer) -> Answer:
    """The destination owns the name: what is left of the source goes."""
    luggage.withdraw(_state(arguments), int(arguments["source"]))
    pid = _pids(arguments).get(_instance(arguments, "source"), 0)
    if pid and tree.is_alive(pid):
        control = _control_of(pid)
        status = status_of(control)
        dumping.kill(pid)
        # Where both hosts share it, it says by now that the node runs.
        if status is not None and status.state is State.LEFT:
            remove_directory(control)
    return {}


def _leave(pid: int, control: Path, arguments: Answer) -> float:
    """Seconds that it took by the node's own word."""
    attempt, root = _attempt(arguments), tree.root_of(pid)
    if tree.is_stopped(root):  # an earlier asking of this very step has dumped it
        dumping.resume(pid)
    _check_wanted(arguments)
    ask_prepare(control, root, attempt)
    status = await_left(control, attempt, float(arguments["seconds"]["leave"]), root)
    return status.seconds.get("leave", 0.0)


def _dump(pid: int, arguments: Answer) -> Path:
    directory = outgoing(_state(arguments), int(arguments["source"]))
    luggage.discard(directory)
    _check_wanted(arguments)
    try:
        dumping.dump(
            find(), pid, directory, leave="stopped", timeout=float(arguments["seconds"]["dump"]),
            process=str(arguments["process"]), instance=int(arguments["source"]),
        )  # fmt: skip
    except CriuError as error:
        raise CriuError(_LOG.sub("", str(error))) from None
    return directory


def _offer(sender: Sender, directory: Path, arguments: Answer) -> Offer:
    seconds = float(arguments["seconds"]["offer"])
    _check_wanted(arguments)
    offer = sender.offer(
        directory, seconds=seconds, max_rate=float(arguments["max_rate"]),
        to=str(arguments["results"][INTRODUCE]["certificate"]),
    )  # fmt: skip
    luggage.remove_when_over(_state(arguments), int(arguments["source"]), sender, seconds)
    return offer


def _check_wanted(arguments: Answer) -> None:
    with _turning:
        if _attempt(arguments) in _turned_back:
            raise CriuError("the move was turned back meanwhile")


def _call_back(pid: int, control: Path, arguments: Answer) -> bool:
    """Let it go on where it stands still, and ask it to join; that is not waited for.

    False: it cannot be asked, so it is no portable node, and never was asked to leave.
    """
    luggage.withdraw(_state(arguments), int(arguments["source"]))
    dumping.resume(pid)
    try:
        ask_resume(control, tree.root_of(pid), _attempt(arguments))
    except PortableError:
        return False
    return True


# --- the destination --------------------------------------------------------------------------


def introduce(arguments: Answer) -> Answer:
    """Be ready for the image, before anything stands still; say who alone may fetch it."""
    named = arguments.get("working_directory")
    if named and not Path(named).expanduser().is_dir():
        raise CriuError(
            f"its working directory {named} does not exist on {arguments['here']['host']}: make it"
        )
    certificate = luggage.open_fetcher(int(arguments["destination"]), float(arguments["keep"]))
    return {"certificate": certificate}


def fetch_image(arguments: Answer) -> Answer:
    """Bring the image here, for the start that follows."""
    return luggage.once(FETCH, _attempt(arguments), lambda: _fetch(arguments))


def _fetch(arguments: Answer) -> Answer:
    told, number = arguments["results"][CHECKPOINT], int(arguments["destination"])
    uid, control = int(told["uid"]), Path(told["control"])
    if control != control_directory(control.name, uid):
        raise PortableError(f"{control} is no control directory of user {uid}")
    directory = incoming(_state(arguments), number)
    luggage.discard(directory)
    fetcher = luggage.take_fetcher(number)
    if fetcher is None:
        raise CriuError(
            f"the slave of {arguments['here']['host']} was started again in the midst of the move, "
            f"and the image is for the former one alone: ask for the move again"
        )
    try:
        fetched = fetcher.fetch(
            Offer.from_json(told["offer"]), directory, timeout=float(arguments["timeout"]),
            reserve=int(arguments["reserve"]),
        )  # fmt: skip
    finally:
        luggage.close_soon(fetcher)
    luggage.remove_unused_later(directory, float(arguments["keep"]))
    make_directory(control, uid)
    return {"seconds": {"transfer": fetched.seconds}, "received": fetched.received}


def await_restored(arguments: Answer) -> Answer:
    """Wait until the image is a process again; there is nothing left of one that cannot be."""
    pid = _pids(arguments).get(_instance(arguments, "destination"), 0)
    directory = incoming(_state(arguments), int(arguments["destination"]))
    try:
        found = outcome.wait(
            directory, timeout=float(arguments["timeout"]), ended=lambda: not tree.is_alive(pid)
        )
    except CriuError as error:
        luggage.remove_unused(directory)
        raise CriuError(_LOG.sub("", str(error))) from None
    return {"seconds": {"restore": found.seconds}}


def join(arguments: Answer) -> Answer:
    """Have the node join the ROS graph here; one that never can is ended: its policy goes on."""
    attempt, timeout = _attempt(arguments), float(arguments["timeout"])
    pid = _pids(arguments).get(_instance(arguments, "destination"), 0)
    root, began = tree.root_of(pid), time.monotonic()
    try:
        control = _control_of(pid)
        ask_resume(control, root, attempt)
        status = await_joined(control, attempt, timeout, root)
    except (CriuError, PortableError) as error:
        if not (tree.is_alive(root) and tree.is_alive(pid)):
            return {"fault": "it has ended"}
        if not _has_failed(_control_of(pid)):
            raise
        dumping.kill(pid)
        return {"fault": str(error)}
    return {"seconds": _of_joining(status, began), "missing": list(status.missing)}


def _has_failed(control: Path) -> bool:
    found = status_of(control)
    return found is not None and found.state is State.FAILED


def _of_joining(status: Status, began: float) -> dict[str, float]:
    own = {f"node_{name}": value for name, value in status.seconds.items()}
    return {"join": time.monotonic() - began, **own}


# --- both -------------------------------------------------------------------------------------


def _attempt(arguments: Answer) -> str:
    """Of this move, in what the node is asked, too."""
    return str(arguments["attempt"])


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
