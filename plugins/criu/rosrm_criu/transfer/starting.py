"""Handles of the two ends of a transfer, each of which is a separate process."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import subprocess
import sys
import tarfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosrm.errors import TransferError
from rosrm_criu.transfer.form import Fetched, Offer, OfferResult

if TYPE_CHECKING:
    from typing_extensions import Self

#: Bytes per second; leaves part of a gigabit network to others.
DEFAULT_RATE: Final = 100e6
#: Bytes that must stay free on the file system of a target.
DEFAULT_RESERVE: Final = 256 << 20
#: Seconds for a process to start and answer, and to end, on a busy machine.
_START: Final = 30.0
_END: Final = 10.0
_NEEDED: Final = ("cryptography",)


def missing() -> str:
    """Return what this Python lacks for a transfer, with the remedy; "": nothing."""
    names = [*_NEEDED, "compression" if sys.version_info >= (3, 14) else "backports.zstd"]
    absent = [name for name in names if not _is_there(name)]
    if absent:
        return f"{', '.join(absent)} is not installed: pip install rosrm-criu"
    if not hasattr(tarfile, "data_filter"):
        return "this Python cannot check archives: it needs 3.10.12, 3.11.4, or a newer one"
    return ""


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False  # a submodule of backports, where that package is missing


class _End:
    """The process of one end; it ends together with this process, even after a crash.

    It may be started in advance, because its libraries take a while to load.

    Raises:
        TransferError: a library is missing here.
    """

    def __init__(self, kind: str) -> None:
        if lack := missing():
            raise TransferError(lack)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rosrm_criu.transfer", kind],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd="/",
            start_new_session=True,
        )
        self._closing = threading.Lock()
        self._begun = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def ready(self) -> None:
        """Wait until the process has loaded its libraries, before a step where time matters.

        Raises:
            TransferError: it has ended, or is not ready in time.
        """
        self._ask({"ready": True}, _START)

    def _begin(self) -> None:
        if self._begun:
            raise RuntimeError("one process makes one transfer: start another one")
        self._begun = True

    def _ask(self, asked: Mapping[str, Any], timeout: float) -> dict[str, Any]:
        """Send a request and return the answer; raise `TransferError` for an error or no answer."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended: no answer will come
            self._process.stdin.write(json.dumps(asked).encode() + b"\n")
            self._process.stdin.flush()
        answer = self._answer(timeout)
        if "error" in answer:
            raise TransferError(answer["error"])
        return answer

    def _answer(self, timeout: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        late = threading.Timer(timeout, self._process.kill)
        late.start()
        try:
            line = self._process.stdout.readline()
        finally:
            late.cancel()
        if not line.endswith(b"\n"):
            status = self._process.wait()
            raise TransferError(
                f"the process of the transfer ended with status {status} and no answer: the log of "
                "who started it may say why"
            )
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _end(self) -> None:
        """End the process and wait; callable from any thread, also while another thread waits."""
        with self._closing:
            assert self._process.stdin is not None
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            try:
                self._process.wait(_END)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


class Sender(_End):
    """The sending end: it listens only between `offer` and `close`.

    Keep a reference: the offer ends when its sender is garbage-collected.
    """

    def __init__(self) -> None:
        super().__init__("send")
        self._sent: OfferResult | None = None

    def offer(
        self, directory: Path, *, seconds: float, to: str, max_rate: float = DEFAULT_RATE
    ) -> Offer:
        """Offer a directory, once.

        Args:
            directory: contains files and directories; it must not change until the offer ends.
            seconds: validity of the offer.
            to: result of the destination's `Fetcher.introduce`: only this one may fetch.
            max_rate: most compressed bytes per second to send; 0: no bound.

        Raises:
            TransferError: the directory cannot be offered.
        """
        self._begin()
        asked = {
            "directory": str(directory.absolute()), "seconds": seconds, "max_rate": max_rate,
            "to": to,
        }  # fmt: skip
        return Offer.from_json(self._ask(asked, _START))

    def wait(self, timeout: float) -> OfferResult | None:
        """Return the result of the offer; None: it still stands after `timeout` seconds."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None
        return self.close()

    def close(self) -> OfferResult:
        """End the offer, if it still stands, and return its result."""
        self._end()
        with self._closing:
            if self._sent is None:
                self._sent = self._read_sent()
        return self._sent

    def _read_sent(self) -> OfferResult:
        assert self._process.stdout is not None
        with self._process.stdout as output, contextlib.suppress(ValueError, TypeError):
            return OfferResult(**json.loads(output.readline()))
        return OfferResult("failed", 0)


class Fetcher(_End):
    """The receiving end, for one fetch."""

    def __init__(self) -> None:
        super().__init__("fetch")

    def introduce(self) -> str:
        """Return a certificate that only this fetch can show, for `Sender.offer`; call this first.

        The certificate is no secret; its key stays in the process.

        Raises:
            TransferError: the process has ended.
        """
        return str(self._ask({"introduce": True}, _START)["certificate"])

    def fetch(
        self, offer: Offer, target: Path, *, timeout: float, reserve: int = DEFAULT_RESERVE
    ) -> Fetched:
        """Fetch an offered directory, readable by its owner alone (0700, 0600); or leave nothing.

        The source must have got the result of `introduce`.

        Args:
            offer: the source's offer.
            target: path of the new directory, which must not exist yet.
            timeout: seconds for the whole fetch.
            reserve: bytes that must stay free on the file system of the target.

        Raises:
            TransferError: the directory cannot be fetched completely or in time, or lacks space.
        """
        self._begin()
        asked = {
            "offer": offer.as_json(), "target": str(target.absolute()), "timeout": timeout,
            "reserve": reserve,
        }  # fmt: skip
        return Fetched(**self._ask(asked, timeout + _START))

    def close(self) -> None:
        """Stop the process; a fetch under way raises `TransferError` and leaves nothing."""
        self._end()
