"""Transfers with faults of the network, the disk and the source."""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import random
import signal
import socket
import tarfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.errors import TransferError
from rosrm_criu.transfer import Offer, OfferResult
from rosrm_criu.transfer.archive import Archive
from rosrm_criu.transfer.sending import serve
from tests.faults.disks import small_disk
from tests.integration.transfer.trees import (
    PATIENCE,
    Destination,
    digests,
    fetching,
    listens,
    nothing_left,
    slowly,
    through,
)
from tests.integration.transfer.wires import Fault, wire

# --- faults of the network -------------------------------------------------------------------


@pytest.mark.parametrize("fault", [Fault(after=1_000_000), Fault(after=1_000_000, flips=True)])
def test_a_broken_stream_fails_and_leaves_nothing(offer, target, sender, destination, fault):
    """A cut or damaged stream ends the fetch and the offer; both sides keep nothing of it."""
    why = rf"the transfer was cut: .*; \d{{5,}} of {offer.length} bytes had come"
    with wire(offer.port, fault) as broken, pytest.raises(TransferError, match=why):
        destination.fetch(through(offer, broken.port), target)
    assert nothing_left(target)
    assert sender.wait(PATIENCE).outcome == "broken"
    assert not listens(offer.port)


def test_a_cut_that_ends_is_bridged(source, target, sender, destination):
    """A stream whose packets come late continues; nothing is sent twice."""
    offer = slowly(sender, source, destination.certificate)
    with fetching(destination, offer, target) as going:
        os.kill(sender._process.pid, signal.SIGSTOP)
        time.sleep(1.0)
        os.kill(sender._process.pid, signal.SIGCONT)
        assert going.result(PATIENCE).received < 4_500_000
    assert digests(target) == digests(source)


def test_a_silent_source_is_given_up_in_time(source, target, sender, destination):
    """The fetch gives up a source that is stopped, and neither sends nor closes."""
    offer = slowly(sender, source, destination.certificate)
    with fetching(destination, offer, target, timeout=3.0) as going:
        try:
            os.kill(sender._process.pid, signal.SIGSTOP)
            with pytest.raises(TransferError, match=r"took longer than 3 s"):
                going.result(PATIENCE)
        finally:
            os.kill(sender._process.pid, signal.SIGCONT)
    assert nothing_left(target)


def test_a_transfer_that_takes_too_long_is_given_up(source, target, sender, destination):
    offer = sender.offer(source, seconds=PATIENCE, max_rate=500e3, to=destination.certificate)
    with pytest.raises(TransferError, match=r"took longer than 1 s; \d+ of \d+ bytes had come"):
        destination.fetch(offer, target, timeout=1.0)
    assert nothing_left(target)


def test_a_server_at_no_address_is_an_error(offer, target, sender, destination):
    """The error names all addresses that refused."""
    sender.close()
    with pytest.raises(TransferError) as caught:
        destination.fetch(offer, target)
    for address in offer.addresses:
        assert f"{address}:{offer.port}: connection refused" in str(caught.value)
    assert nothing_left(target)


def test_an_offer_ends_by_itself(source, target, sender, destination):
    offer = sender.offer(source, seconds=0.2, to=destination.certificate)
    assert sender.wait(PATIENCE) == OfferResult("expired", 0)
    assert not listens(offer.port)
    with pytest.raises(TransferError, match=r"its offer, which stands for 0\.2 s, may be over"):
        destination.fetch(offer, target)


def test_an_offer_that_ends_in_mid_transfer(source, target, sender, destination):
    offer = sender.offer(source, seconds=1.0, max_rate=500e3, to=destination.certificate)
    with pytest.raises(TransferError, match=r"the transfer was cut"):
        destination.fetch(offer, target)
    assert sender.close().outcome == "expired"
    assert nothing_left(target)


def test_files_that_changed_since_they_were_offered_are_refused(offer, source, target, destination):
    (source / "pages" / "1.img").write_bytes(b"other")
    with pytest.raises(TransferError, match=r"refuses .*1\.img has changed since it was offered"):
        destination.fetch(offer, target)
    assert nothing_left(target)


def test_a_directory_that_is_gone_since_it_was_offered(offer, source, target, destination):
    source.rename(source.with_name("elsewhere"))
    with pytest.raises(TransferError, match=r"refuses .* is gone"):
        destination.fetch(offer, target)


# --- faults of the source --------------------------------------------------------------------


@contextlib.contextmanager
def lying(directory: Path, to: str) -> Iterator[Offer]:
    """Serve in this process, where a test can replace parts of the server."""
    made: queue.Queue[Offer] = queue.Queue()
    over = threading.Event()
    arguments = {"seconds": PATIENCE, "max_rate": 0, "to": to, "announce": made.put, "over": over}
    thread = threading.Thread(target=serve, args=(directory,), kwargs=arguments, daemon=True)
    thread.start()
    try:
        offer = made.get(timeout=PATIENCE)
        yield through(offer, offer.port)
    finally:
        over.set()
        thread.join(PATIENCE)


def assert_refused(source: Path, target: Path, why: str) -> None:
    destination = Destination()
    with lying(source, destination.certificate) as offer, pytest.raises(TransferError, match=why):
        destination.fetch(offer, target)
    assert nothing_left(target)


def test_a_wrong_checksum_is_noticed(source, target, monkeypatch):
    honest = Archive.pieces
    monkeypatch.setattr(Archive, "pieces", lambda self: [*[*honest(self)][:-1], bytes(32)])
    assert_refused(source, target, r"does not match its checksum")


def test_no_more_is_taken_than_was_offered(source, target, monkeypatch):
    """A source without end cannot fill the disk."""
    offered = Archive(source)
    head = next(offered.pieces())

    def endless(self):
        entry = tarfile.TarInfo("endless")
        entry.size = 1 << 40
        return itertools.chain([entry.tobuf()], itertools.repeat(bytes(1 << 16)))

    assert len(head) < offered.length
    monkeypatch.setattr(Archive, "pieces", endless)
    assert_refused(source, target, r"no sound archive|ends within 'endless'")


def test_a_stream_that_is_no_zstandard_is_refused(source, target, monkeypatch):
    monkeypatch.setattr(Archive, "compressed", lambda self: iter([b"plain" * 1000]))
    assert_refused(source, target, r"the received data is damaged")


def test_a_part_that_is_too_large_is_refused(source, target, monkeypatch):
    """A source cannot make the destination wait for a part without end."""
    monkeypatch.setattr(Archive, "compressed", lambda self: iter([bytes(1 << 25)]))
    assert_refused(source, target, r"a part of it is too large")


# --- disks -----------------------------------------------------------------------------------


def test_what_has_no_room_is_not_begun(offer, tmp_path, destination):
    """The offer still stands after a refusal for lack of space, so another place can fetch it."""
    with small_disk(tmp_path / "disk") as disk:
        with pytest.raises(TransferError, match=r"do not fit .* the file system .*/disk has"):
            destination.fetch(offer, disk.place / "target", reserve=0)
        assert list(disk.place.iterdir()) == []
    destination.fetch(offer, tmp_path / "target")


def test_a_disk_that_becomes_full_during_the_transfer(sender, tmp_path, destination):
    """A disk that others fill during the fetch fails it; the error names the file system."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "pages").write_bytes(random.Random(7).randbytes(600_000))
    with small_disk(tmp_path / "disk") as disk:
        offer = sender.offer(source, seconds=PATIENCE, max_rate=200e3, to=destination.certificate)
        with fetching(destination, offer, disk.place / "target", reserve=0) as going:
            disk.fill()
            with pytest.raises(TransferError, match=r"No space left on device; the file system"):
                going.result(PATIENCE)
        assert [path.name for path in disk.place.iterdir()] == ["filler"]


def test_silent_strangers_take_few_threads_and_no_place(
    offer, source, target, sender, destination
) -> None:
    """Each connection without a reader has a thread; beyond a bound the oldest one ends."""
    tasks = Path(f"/proc/{sender._process.pid}/task")
    with contextlib.ExitStack() as closing:
        for _ in range(200):
            stranger = socket.create_connection(("127.0.0.1", offer.port), PATIENCE)
            closing.enter_context(stranger)
        destination.fetch(offer, target)
        assert len(list(tasks.iterdir())) < 60
    assert digests(target) == digests(source)
