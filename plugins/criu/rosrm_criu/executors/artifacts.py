"""A slave's images and transfer ends of migrations by `criu`, with automatic cleanup.

A slave may be killed and restarted. So artifacts are identified by the number of an instance, and
unused ones are removed after a time.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from rosrm import threads
from rosrm.shortage import exists
from rosrm_criu.engine import image, process_tree, restore_result
from rosrm_criu.engine.paths import checkpoint, incoming, numbers, outgoing
from rosrm_criu.engine.restore_result import Outcome
from rosrm_criu.executors.request import StepArguments, undoing, without_log_names
from rosrm_criu.transfer import Fetcher, Sender

_log: Final = logging.getLogger("rosrm.criu")
#: Seconds after which an image that a killed slave has left is no longer needed for a start.
_LEFT_BEHIND: Final = 120.0

#: File below an image copied for a restore: number of the instance whose checkpoint it is.
_ORIGIN: Final = "of"

_changing: Final = threading.Lock()
_senders: Final[dict[int, Sender]] = {}
_fetchers: Final[dict[int, Fetcher]] = {}


# --- the source -------------------------------------------------------------------------------


def open_sender(number: int) -> Sender:
    """Open the sending end for the image of an instance, and close a former one of it."""
    sender = Sender()
    with _changing:
        former = _senders.get(number)
        _senders[number] = sender
    if former is not None:
        former.close()
    sender.ready()
    return sender


def remove_when_over(state: Path, number: int, sender: Sender, seconds: float) -> None:
    """Remove an offered image once it was fetched, or the fetch failed or came too late.

    Args:
        state: directory of the slave.
        number: of the instance whose image it is.
        sender: of the image.
        seconds: validity of the offer.
    """

    def wait() -> None:
        sender.wait(seconds + 5.0)
        with _changing:
            if _senders.get(number) is not sender:
                return  # withdrawn: there may already be another image
            del _senders[number]
            discard(outgoing(state, number))
        sender.close()

    threads.start(wait, "offered image")


def withdraw(state: Path, number: int) -> None:
    """Withdraw the offer of an instance, and remove its image."""
    with _changing:
        sender = _senders.pop(number, None)
    if sender is not None:
        sender.close()
    discard(outgoing(state, number))


# --- the destination --------------------------------------------------------------------------


def open_fetcher(number: int, keep: float) -> str:
    """Open the receiving end for a future instance, and return its certificate.

    Args:
        number: of the instance.
        keep: seconds after which an unused end is closed.
    """
    fetcher = Fetcher()
    with undoing(fetcher.close):  # no other code would close this end
        certificate = fetcher.introduce()
    with _changing:
        former = _fetchers.get(number)
        _fetchers[number] = fetcher
    if former is not None:
        former.close()
    call_later(keep, _dismiss, number, fetcher)
    return certificate


def take_fetcher(number: int) -> Fetcher | None:
    """Return the receiving end, for its only fetch; None: it is closed or was never opened."""
    with _changing:
        return _fetchers.pop(number, None)


def close_soon(fetcher: Fetcher) -> None:
    """Close the receiving end in the background, because a node is frozen until the restore."""
    call_later(0.0, fetcher.close)


def _dismiss(number: int, fetcher: Fetcher) -> None:
    with _changing:
        if _fetchers.get(number) is not fetcher:
            return
        del _fetchers[number]
    fetcher.close()


def await_restored(asked: StepArguments) -> Outcome:
    """Wait until the received image is restored; then remove it, except the result of the restore.

    Raises:
        CriuError: the restore failed.
    """
    pid, directory = asked.pid(asked.destination), incoming(asked.state, asked.destination)
    with without_log_names():
        found = restore_result.wait(
            directory,
            timeout=asked.timeout,
            ended=lambda: not pid or not process_tree.is_alive(pid),
        )
    image.remove(directory)  # its shim may have been killed before it removed the image
    return found


def remove_unused_later(directory: Path, keep: float) -> None:
    """Call `remove_unused` after `keep` seconds, or later if a restore from the image runs then."""
    call_later(keep, _remove_if_idle, directory, keep)


def _remove_if_idle(directory: Path, keep: float) -> None:
    # The shim stays after the restore, and the image is then no longer needed.
    try:
        if not process_tree.has_shim(directory) or restore_result.was_restored(directory):
            remove_unused(directory)
            return
    except OSError as error:
        _log.warning("the image %s stays for %g s more: %s", directory, keep, error)
    remove_unused_later(directory, keep)


def remove_unused(directory: Path) -> None:
    """Remove an image; if a process was restored from it, keep the result of the restore.

    Raises:
        OSError: no look at the result is possible now; nothing was removed.
    """
    if restore_result.was_restored(directory):
        image.remove(directory)  # its shim may have been killed before it removed the image
    else:
        discard(directory)


# --- both -------------------------------------------------------------------------------------


def discard(directory: Path) -> None:
    """Remove an image completely."""
    shutil.rmtree(directory, ignore_errors=True)


def sweep(state: Path, instances: Iterable[str]) -> None:
    """Remove the artifacts of a former slave of this host.

    Args:
        state: directory of the slave.
        instances: `process#number` of each instance on this host that has not ended.
    """
    with _changing:
        for number in numbers(state, "out"):
            if number not in _senders:
                discard(outgoing(state, number))
    forget_restored(state, instances)
    for number in numbers(state, "in"):
        remove_unused_later(incoming(state, number), _LEFT_BEHIND)


def forget_restored(state: Path, instances: Iterable[str]) -> None:
    """Remove the restore results of instances that have ended.

    The supervisor needs a result to restart an instance. So does the question of whether a
    checkpoint was used, as long as its image exists. Arguments as for `sweep`.
    """
    here = set(map(number_of, instances))
    for number in numbers(state, "in"):
        directory = incoming(state, number)
        try:
            if number not in here and _is_over(state, directory):
                discard(directory)
        except OSError as error:
            _log.warning("the result of the restore of %s stays: %s", directory, error)


def note_origin(directory: Path, number: int) -> None:
    """Record in a copied image the instance whose checkpoint it is."""
    (directory / _ORIGIN).write_text(str(number), encoding="utf-8")


def _is_over(state: Path, directory: Path) -> bool:
    """Return True if a process was restored, and the checkpoint that was copied is gone.

    Raises:
        OSError: no look is possible now.
    """
    if not restore_result.was_restored(directory):
        return False
    try:
        origin = int((directory / _ORIGIN).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return True
    return not exists(checkpoint(state, origin))


def number_of(instance: str) -> int:
    """Return the number in `process#number`."""
    return int(instance.rpartition("#")[2])


def call_later(seconds: float, do: Callable[..., None], *arguments: Any) -> None:
    """Call a function later, in a thread that does not keep the slave from ending.

    If no thread can be started, call it now if it is due, and otherwise leave it to `sweep`.
    """

    def call() -> None:
        time.sleep(seconds)
        do(*arguments)

    try:
        threads.start(call, f"criu: {do.__name__}")
    except RuntimeError as fault:
        if not seconds:
            do(*arguments)
        else:
            _log.error("%s in %g s: %s", do.__name__, seconds, fault)
