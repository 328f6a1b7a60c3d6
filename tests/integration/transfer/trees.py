"""Directories to transfer, and checks of their arrival."""

from __future__ import annotations

import dataclasses
import hashlib
import random
import socket
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from rosrm_criu.transfer import DEFAULT_RESERVE, Fetched, Fetcher, Offer, Sender
from rosrm_criu.transfer.certificate import new_identity
from rosrm_criu.transfer.receiving import receive
from tests.waiting import wait_until

#: Seconds; generous for a busy machine.
PATIENCE = 60.0


class Destination:
    """A known destination that fetches in this process, any number of times.

    Attributes:
        certificate: for the source.
        fingerprint: of the certificate.
    """

    def __init__(self) -> None:
        self._identity = new_identity()
        self.certificate = self._identity.certificate
        self.fingerprint = self._identity.fingerprint

    def fetch(
        self, offer: Offer, target: Path, *, timeout: float = PATIENCE,
        reserve: int = DEFAULT_RESERVE,
    ) -> Fetched:  # fmt: skip
        return receive(
            offer, target, timeout=timeout, reserve=reserve, identity=self._identity,
            before_placing=lambda: None,
        )  # fmt: skip


def fill(directory: Path, *, megabytes: int, random_share: float = 1.0) -> None:
    (directory / "pages" / "empty").mkdir(parents=True)
    bits = random.Random(7)
    for number in range(4):
        with (directory / "pages" / f"{number}.img").open("wb") as file:
            for _ in range(megabytes * 1_000_000 // 4 // 50_000):
                fresh = int(50_000 * random_share)
                file.write(bits.randbytes(fresh) + bytes(50_000 - fresh))
    (directory / "inventory").write_bytes(b"1")


def digests(directory: Path) -> dict[str, str]:
    return {
        str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest()
        if path.is_file() else "directory"
        for path in directory.rglob("*")
    }  # fmt: skip


def through(offer: Offer, port: int) -> Offer:
    return dataclasses.replace(offer, addresses=("127.0.0.1",), port=port)


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
    except ConnectionRefusedError:
        return False
    return True


def wait_until_begun(target: Path) -> None:
    """Wait until the first files of a fetch have arrived beside its target."""
    wait_until(lambda: list(target.parent.glob(".rosrm-fetch-*/*")), "the first files")


@contextmanager
def fetching(by: Destination | Fetcher, offer: Offer, target: Path, **more) -> Iterator[Future]:
    """Fetch in another thread; yield the running fetch once its first files have arrived."""
    with ThreadPoolExecutor() as threads:
        going = threads.submit(by.fetch, offer, target, **more)
        wait_until_begun(target)
        yield going


def nothing_left(target: Path) -> bool:
    return not target.parent.exists() or list(target.parent.iterdir()) == []


def slowly(sender: Sender, source: Path, to: str) -> Offer:
    return sender.offer(source, seconds=PATIENCE, to=to, max_rate=500e3)
