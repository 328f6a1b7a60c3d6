"""What a slave holds of moves by `criu`: images and the ends of transfers, which go by themselves.

A master may ask for a step a second time, and turn a move back while a step is under way; a slave
may be killed and be started again. So steps are known by the attempt, and things by the number of
an instance; what nobody uses any more is removed after a time.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final

from rosrm.errors import CriuError
from rosrm_criu.engine import image, process_tree, restore_result
from rosrm_criu.engine.paths import incoming, kept, outgoing
from rosrm_criu.engine.restore_result import Outcome
from rosrm_criu.executors.request import Asked, without_log_names
from rosrm_criu.transfer import Fetcher, Sender

Answer = Mapping[str, Any]

#: Of an image that a killed slave has left: seconds after which nobody will start from it.
_LEFT_BEHIND: Final = 120.0
#: Steps whose answers are remembered; far more than there are moves at a time.
_REMEMBERED: Final = 50

#: Below an image that was laid out to be restored: of which instance it is kept.
_ORIGIN: Final = "of"

_changing: Final = threading.Lock()
_senders: Final[dict[int, Sender]] = {}
_fetchers: Final[dict[int, Fetcher]] = {}
_flights: Final[dict[tuple[str, str], Future[Answer]]] = {}
_dumping: Final[defaultdict[int, threading.Lock]] = defaultdict(threading.Lock)


# --- steps that are asked for twice -----------------------------------------------------------


def once(step: str, attempt: str, work: Callable[[], Answer]) -> Answer:
    """Do a step; who asks for it again while it is done, or afterwards, gets the same answer.

    Args:
        step: its name.
        attempt: of the move.
        work: the step. When it raises it is forgotten, and done anew when it is asked for again.
    """
    with _changing:
        flight = _flights.get((step, attempt))
        is_ours = flight is None
        if flight is None:
            flight = _flights[step, attempt] = Future()
            while len(_flights) > _REMEMBERED:
                del _flights[next(iter(_flights))]
    if not is_ours:
        return flight.result()
    try:
        answer = work()
    except BaseException as error:
        with _changing:
            _flights.pop((step, attempt), None)
        flight.set_exception(error)
        raise
    flight.set_result(answer)
    return answer


def after(step: str, attempt: str, timeout: float) -> None:
    """Wait until a step that is under way is over; raises CriuError after so many seconds."""
    with _changing:
        flight = _flights.get((step, attempt))
    if flight is None:
        return
    try:
        flight.exception(timeout)
    except TimeoutError:
        raise CriuError(f"{step} is still under way after {timeout:g} s") from None


@contextlib.contextmanager
def alone(number: int, timeout: float) -> Iterator[None]:
    """Nobody else dumps an instance meanwhile.

    Raises:
        CriuError: somebody does, for longer than so many seconds.
    """
    with _changing:
        lock = _dumping[number]
    if not lock.acquire(timeout=timeout):
        raise CriuError(f"another dump of it is still under way after {timeout:g} s")
    try:
        yield
    finally:
        lock.release()


def is_busy(number: int) -> bool:
    """Whether an instance is being dumped for this slave."""
    with _changing:
        return _dumping[number].locked()


# --- the source -------------------------------------------------------------------------------


def open_sender(number: int) -> Sender:
    """The end of a transfer, ready for the image of an instance; a former one of it is over."""
    sender = Sender()
    with _changing:
        former = _senders.get(number)
        _senders[number] = sender
    if former is not None:
        former.close()
    sender.ready()
    return sender


def remove_when_over(state: Path, number: int, sender: Sender, seconds: float) -> None:
    """Remove an image that was offered when it was taken, or its time is over."""

    def wait() -> None:
        sender.wait(seconds + 5.0)
        with _changing:
            if _senders.get(number) is not sender:
                return  # withdrawn: there may be another image by now
            del _senders[number]
            discard(outgoing(state, number))
        sender.close()

    threading.Thread(target=wait, name="offered image", daemon=True).start()


def withdraw(state: Path, number: int) -> None:
    """There is no offer any more, nor an image."""
    with _changing:
        sender = _senders.pop(number, None)
    if sender is not None:
        sender.close()
    discard(outgoing(state, number))


# --- the destination --------------------------------------------------------------------------


def open_fetcher(number: int, keep: float) -> str:
    """The end of a transfer for an instance that is to be; the certificate that it will show."""
    fetcher = Fetcher()
    try:
        certificate = fetcher.introduce()
    except BaseException:  # whatever it was: nobody else knows of this end
        fetcher.close()
        raise
    with _changing:
        former = _fetchers.get(number)
        _fetchers[number] = fetcher
    if former is not None:
        former.close()
    _later(keep, _dismiss, number, fetcher)
    return certificate


def take_fetcher(number: int) -> Fetcher | None:
    """That end, for the one fetch that it makes; None: it is gone, or never was."""
    with _changing:
        return _fetchers.pop(number, None)


def close_soon(fetcher: Fetcher) -> None:
    """End it; somebody stands still until the image is restored, and does not wait for that."""
    _later(0.0, fetcher.close)


def _dismiss(number: int, fetcher: Fetcher) -> None:
    with _changing:
        if _fetchers.get(number) is not fetcher:
            return
        del _fetchers[number]
    fetcher.close()


def await_restored(asked: Asked) -> Outcome:
    """Wait until the image that came here is a process again; that alone stays to be known then.

    Raises:
        CriuError: it has become none.
    """
    pid, directory = asked.pid(asked.destination), incoming(asked.state, asked.destination)
    with without_log_names():
        found = restore_result.wait(
            directory,
            timeout=asked.timeout,
            ended=lambda: not pid or not process_tree.is_alive(pid),
        )
    image.remove(directory)  # its hold may have been killed before it did
    return found


def remove_unused_later(directory: Path, keep: float) -> None:
    """As `remove_unused`, after so many seconds."""
    _later(keep, remove_unused, directory)


def remove_unused(directory: Path) -> None:
    """Remove an image; where a process was restored from it, that stays to be known."""
    if was_restored(directory):
        image.remove(directory)  # its hold may have been killed before it did
    else:
        discard(directory)


def was_restored(directory: Path) -> bool:
    """Whether an image has become a process, which may have ended since."""
    try:
        told = restore_result.read(directory)
    except CriuError:
        return False
    return told is not None and not told.reason


# --- both -------------------------------------------------------------------------------------


def discard(directory: Path) -> None:
    """Nothing of an image is left."""
    shutil.rmtree(directory, ignore_errors=True)


def sweep(state: Path, instances: Iterable[str]) -> None:
    """Remove what a former slave of this host has left.

    Args:
        state: of the slave.
        instances: `process#number` of each that has not ended here.
    """
    with _changing:
        for number in _numbers(state, "out"):
            if number not in _senders:
                discard(outgoing(state, number))
    forget_restored(state, instances)
    here = set(map(number_of, instances))
    for number in _numbers(state, "in"):
        if number not in here:
            remove_unused_later(incoming(state, number), _LEFT_BEHIND)


def forget_restored(state: Path, instances: Iterable[str]) -> None:
    """Remove what says of instances that were restored, and have ended, that they were.

    Their supervisor needs it to start them again; so does who asks whether a kept image was used
    up, as long as that lies there. As `sweep`.
    """
    here = set(map(number_of, instances))
    for number in _numbers(state, "in"):
        directory = incoming(state, number)
        if number not in here and was_restored(directory) and not _is_awaited(state, directory):
            discard(directory)


def note_origin(directory: Path, number: int) -> None:
    """An image was laid out from that which is kept of an instance."""
    (directory / _ORIGIN).write_text(str(number), encoding="utf-8")


def _is_awaited(state: Path, directory: Path) -> bool:
    try:
        origin = int((directory / _ORIGIN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return kept(state, origin).exists()


def number_of(instance: str) -> int:
    """Of `process#number`."""
    return int(instance.rpartition("#")[2])


def _numbers(state: Path, way: str) -> list[int]:
    images = outgoing(state, 0).parent.glob(f"{way}-*")
    words = [path.name.partition("-")[2] for path in images]
    return [int(word) for word in words if word.isdigit()]


def _later(seconds: float, do: Callable[..., None], *arguments: Any) -> None:
    """In a thread that keeps no slave from ending."""
    timer = threading.Timer(seconds, do, arguments)
    timer.daemon = True
    timer.start()
