"""Executors that copy the memory of a running node to the destination, before a move freezes it.

The dump of the frozen node then sends only the pages that differ. Every failure here means that the
whole dump is sent, so an executor never raises: its answer names the reason.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import CriuError
from rosrm.shortage import is_directory, names
from rosrm_criu.engine import copied_pages, dump, image, memory_copy, page_server, process_tree
from rosrm_criu.engine.memory_copy import CHANGES, MemoryCopy, file_name
from rosrm_criu.engine.paths import numbers, received_copy, sent_copy
from rosrm_criu.executors import artifacts, attempts
from rosrm_criu.executors.attempts import Answer
from rosrm_criu.executors.request import StepArguments, undoing
from rosrm_criu.plans import (
    COPY_CHANGES,
    COPY_MEMORY,
    EXPECT_COPY,
    FETCH_CHANGES,
    FETCH_COPY,
    INTRODUCE,
    MEASURE_MEMORY,
)
from rosrm_criu.transfer import Fetcher, Offer, Sender

#: Minimum bytes of memory for a copy. Less memory is dumped, sent and restored within a second.
LEAST: Final = 64 << 20
#: Minimum bytes of changes for a second copy. Fewer are sent with the dump in a tenth of a second.
LEAST_CHANGES: Final = 8 << 20
#: First part of the names of copies that are being removed.
_UNUSED: Final = ".unused-copy-"


@dataclass(frozen=True)
class _Sent:
    """Copy at the source.

    Attributes:
        copy: its files and pages.
        offer: fingerprint of its offer.
        sender: its sending end.
        former: the first copy, if this is the second one.
    """

    copy: MemoryCopy
    offer: str
    sender: Sender
    former: _Sent | None = None


_changing: Final = threading.Lock()
_sent: Final[dict[int, _Sent]] = {}
#: Fingerprint of the offer of each received copy, by the number of the future instance.
_received: Final[dict[int, str]] = {}


#: Function of a step, called with parsed arguments; executor of the step, called with a mapping.
_Work = Callable[[StepArguments], Answer]
_Executor = Callable[[Answer], Answer]


def _optional(step: str) -> Callable[[_Work], _Executor]:
    """Return a decorator for an executor that runs once per attempt and answers with its error."""

    def decorate(work: _Work) -> _Executor:
        def attempt(asked: StepArguments) -> Answer:
            try:
                return work(asked)
            except Exception as error:  # noqa: BLE001 - after any error the whole dump is sent
                return {"skipped": str(error)}

        @functools.wraps(work)
        def executor(arguments: Answer) -> Answer:
            asked = StepArguments.of(arguments)
            return attempts.once(step, asked.attempt, lambda: attempt(asked))

        return executor

    return decorate


# --- the source -------------------------------------------------------------------------------


@_optional(MEASURE_MEMORY)
def measure_memory(asked: StepArguments) -> Answer:
    """Return the bytes to copy; 0: less than `LEAST`, which is not worth a copy.

    The answer is `skipped` with the reason if the disk has no room for the copy and the dump.
    """
    pids = _pids(asked)
    size = memory_copy.size_of(pids)
    if size < LEAST:
        return {"bytes": 0}
    folder = sent_copy(asked.state, asked.source).parent
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    image.check_room(folder, size + process_tree.memory_of(pids))
    return {"bytes": size}


@_optional(COPY_MEMORY)
def copy_memory(asked: StepArguments) -> Answer:
    """Copy the memory of the running node, and offer the copy."""
    to = asked.answer_of(EXPECT_COPY).get("certificate")
    if not to:
        return {}
    remove_sent_copy(asked.state, asked.source)
    directory = sent_copy(asked.state, asked.source)
    return _offer(
        asked, str(to), directory, lambda check: memory_copy.copy(_pids(asked), directory, check)
    )


@_optional(COPY_CHANGES)
def copy_changes(asked: StepArguments) -> Answer:
    """Copy once more what has changed during the copy and its transfer, and offer these pages."""
    to = asked.answer_of(FETCH_COPY).get("certificate")
    with _changing:
        former = _sent.get(asked.source)
    if not to or former is None:
        return {}
    copied, directory = former.copy, former.copy.directory / CHANGES

    def copy(check: Callable[[], None]) -> MemoryCopy:
        found = memory_copy.copy_changes(copied, _pids(asked), check)
        size, whole = (
            sum((one / file_name(pid)).stat().st_size for pid in found.ranges)
            for one in (directory, copied.directory)
        )
        if not LEAST_CHANGES <= size <= whole / 2:
            raise CriuError(f"{size} of {whole} bytes have changed: too few or too many")
        image.check_room(copied.directory, process_tree.memory_of(_pids(asked)))
        return found

    return _offer(asked, str(to), directory, copy, former)


def _offer(
    asked: StepArguments, to: str, directory: Path,
    copy: Callable[[Callable[[], None]], MemoryCopy], former: _Sent | None = None,
) -> Answer:  # fmt: skip
    """Make a copy of memory, and offer it.

    Args:
        asked: arguments of the step.
        to: certificate of the destination.
        directory: of the copied pages to send; a new one.
        copy: makes the copy; it calls its argument again and again.
        former: the first copy, if this is the second one.
    """
    sender = Sender()
    # After any error no other code would close this end. First the files, because the next attempt
    # may soon use the same directory.
    with undoing(partial(artifacts.discard, directory), sender.close):
        # Half of the timeout, because the sender must start after the copy and before the step
        # times out.
        made = copy(_check_until(asked.attempt, asked.timeout / 2))
        offer = sender.offer(
            directory, seconds=float(asked.arguments["offer"]), to=to,
            max_rate=float(asked.arguments["max_rate"]),
        )  # fmt: skip
        sent = _Sent(made, offer.fingerprint, sender, former)
        with _changing:
            attempts.check_wanted(asked.attempt)
            _sent[asked.source] = sent
    if former is not None:
        former.sender.close()
    artifacts.call_later(
        float(asked.arguments["keep"]), remove_sent_copy, asked.state, asked.source, sent
    )
    return {"offer": offer.as_json()}


def receiver(asked: StepArguments) -> dump.Receive | None:
    """Return the function that leaves pages out of a dump; None: the destination has no copy."""
    with _changing:
        sent = _sent.get(asked.source)
    while sent is not None and sent.offer != asked.results[INTRODUCE].get("copy"):
        sent = sent.former
    if sent is None:
        return None
    copy = sent.copy

    def receive(run: Callable[[int], None], directory: Path) -> Mapping[str, int] | None:
        sizes = page_server.serve(run, directory, copy)
        if sizes is None:  # the second dump may take long, so begin none for an undone move
            attempts.check_wanted(asked.attempt)
        return sizes

    return receive


def _check_until(attempt: str, seconds: float) -> Callable[[], None]:
    """Return a check of a copy under way.

    Args:
        attempt: id of the migration attempt; if it was given up, the check raises CriuError.
        seconds: after which the check raises ValueError.
    """
    deadline = clocks.boot_time() + seconds

    def check() -> None:
        attempts.check_wanted(attempt)
        if clocks.boot_time() > deadline:
            raise ValueError(f"the copy is given up: it has taken longer than {seconds:g} s")

    return check


def remove_sent_copy(state: Path, number: int, only: _Sent | None = None) -> None:
    """Remove the copy of an instance at the source.

    Args:
        state: directory of the slave.
        number: of the instance.
        only: the copy to remove; None: any.
    """
    with _changing:
        sent = _sent.get(number)
        if only is not None and only is not sent:
            return
        _sent.pop(number, None)
        renamed = _renamed(sent_copy(state, number))
    artifacts.discard(renamed)
    if sent is not None:
        sent.sender.close()


def _pids(asked: StepArguments) -> Sequence[int]:
    return process_tree.tree(process_tree.root_of(asked.leader(asked.source)))


# --- the destination --------------------------------------------------------------------------


@_optional(EXPECT_COPY)
def expect_copy(asked: StepArguments) -> Answer:
    """Open the receiving end for the copy, unless the source will send none."""
    if not asked.answer_of(MEASURE_MEMORY).get("bytes"):
        return {}
    keep = float(asked.arguments["keep"])
    return {"certificate": artifacts.open_fetcher(asked.destination, keep)}


@_optional(FETCH_COPY)
def fetch_copy(asked: StepArguments) -> Answer:
    """Fetch the copy, if there is room for the whole dump beside it."""
    copied = asked.answer_of(COPY_MEMORY)
    if "offer" not in copied:
        return {}
    remove_received_copy(asked.state, asked.destination)
    with _receiving_end(asked) as fetcher:
        # Before the fetch, because the node writes more while the next end starts.
        again = artifacts.open_fetcher(asked.destination, float(asked.arguments["keep"]))
        directory = received_copy(asked.state, asked.destination)
        return {**_fetch(asked, fetcher, copied, directory), "certificate": again}


@_optional(FETCH_CHANGES)
def fetch_changes(asked: StepArguments) -> Answer:
    """Fetch the pages that were copied once more."""
    copied = asked.answer_of(COPY_CHANGES)
    if "offer" not in copied:
        return {}
    with _receiving_end(asked) as fetcher:
        directory = received_copy(asked.state, asked.destination) / CHANGES
        return _fetch(asked, fetcher, copied, directory)


@contextlib.contextmanager
def _receiving_end(asked: StepArguments) -> Iterator[Fetcher]:
    fetcher = artifacts.take_fetcher(asked.destination)
    if fetcher is None:
        raise CriuError("the slave was started again since the copy was offered")
    try:
        yield fetcher
    finally:
        artifacts.close_soon(fetcher)


def _fetch(asked: StepArguments, fetcher: Fetcher, copied: Answer, directory: Path) -> Answer:
    """Fetch what the source has copied into a new directory, if the whole dump fits beside it."""
    offer = Offer.from_json(copied["offer"])
    reserve = int(asked.arguments["reserve"]) + int(asked.answer_of(COPY_MEMORY)["offer"]["size"])
    fetched = fetcher.fetch(offer, directory, timeout=asked.timeout, reserve=reserve)
    try:
        copied_pages.check_files(directory)
        with _changing:
            attempts.check_wanted(asked.attempt)
            _received[asked.destination] = offer.fingerprint
    except CriuError:
        artifacts.discard(directory)
        raise
    keep = float(asked.arguments["keep"])
    artifacts.call_later(
        keep, remove_received_copy, asked.state, asked.destination, offer.fingerprint
    )
    return {"seconds": {"transfer": fetched.seconds}, "received": fetched.received}


def received_fingerprint(asked: StepArguments) -> str:
    """Return the fingerprint of the offer of the received copy; "": there is none."""
    with _changing:
        is_here = is_directory(received_copy(asked.state, asked.destination))
        return _received.get(asked.destination, "") if is_here else ""


def put_in_place(asked: StepArguments, directory: Path) -> None:
    """Add the received copy to a received image that refers to it; remove it otherwise."""
    with contextlib.suppress(OSError):  # the check of the image names a file that is missing
        copied_pages.move_into_parent(directory, received_copy(asked.state, asked.destination))
    remove_received_copy(asked.state, asked.destination)


def remove_received_copy(state: Path, number: int, only: str = "") -> None:
    """Remove the copy for an instance at the destination.

    Args:
        state: directory of the slave.
        number: of the instance.
        only: fingerprint of the offer of the copy to remove; "": any.
    """
    with _changing:
        if only and _received.get(number) != only:
            return
        _received.pop(number, None)
        renamed = _renamed(received_copy(state, number))
    artifacts.discard(renamed)


# --- both -------------------------------------------------------------------------------------


def remove_copy(arguments: Answer) -> Answer:
    """Undo a copy at the source or at the destination; one that is under way is given up."""
    asked = StepArguments.of(arguments)
    attempts.turn_back(asked.attempt)
    remove_sent_copy(asked.state, asked.source)
    remove_received_copy(asked.state, asked.destination)
    if fetcher := artifacts.take_fetcher(asked.destination):
        fetcher.close()
    return {}


def sweep(state: Path) -> None:
    """Remove the copies of a former slave of this host."""
    with _changing:
        for number in numbers(state, "copy-out"):
            if number not in _sent:
                _renamed(sent_copy(state, number))
        for number in numbers(state, "copy-in"):
            if number not in _received:
                _renamed(received_copy(state, number))
    for name in names(state / "images"):
        if name.startswith(_UNUSED):
            artifacts.discard(state / "images" / name)


def _renamed(directory: Path) -> Path:
    """Return the new path of a copy, if there is one, whose name is free from now on.

    Its removal takes a while, and may not hold the lock that the dump of a frozen node needs.
    """
    renamed = directory.with_name(f"{_UNUSED}{uuid.uuid4().hex}")
    with contextlib.suppress(FileNotFoundError):
        directory.rename(renamed)
    return renamed
