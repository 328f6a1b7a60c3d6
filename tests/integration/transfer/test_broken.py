"""What can come between two ends: wires, disks, and a source that is not what it should be."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import itertools
import os
import queue
import random
import signal
import tarfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rosrm.errors import TransferError
from rosrm.transfer import Fetcher, Offer, Sent, archive, fetch, serving
from rosrm.transfer.archive import Archive
from rosrm.transfer.serving import serve
from tests.faults.disks import small_disk
from tests.integration.transfer.trees import (
    PATIENCE,
    digests,
    listens,
    nothing_left,
    through,
    until,
)
from tests.integration.transfer.wires import Fault, wire

# --- what comes between ----------------------------------------------------------------------


def test_a_connection_that_was_cut_is_gone_on_with(source, target, sender):
    """What has come is not sent again, but for what was on the way."""
    offer = sender.offer(source, seconds=PATIENCE)
    with wire(offer.port, Fault(after=1_000_000), Fault(after=2_000_000)) as cut:
        fetched = fetch(through(offer, cut.port), target, timeout=PATIENCE)
    assert digests(target) == digests(source)
    assert fetched.resumed == 2
    assert fetched.received < 5_500_000
    assert sender.wait(PATIENCE).outcome == "taken"


def test_a_source_that_is_gone_in_mid_transfer_leaves_nothing(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    why = rf"cut after \d{{5,}} of {offer.length} bytes \(the (TLS )?connection broke\).*refused"
    with (
        wire(offer.port, Fault(after=1_000_000), then_gone=True) as cut,
        pytest.raises(TransferError, match=why),
    ):
        fetch(through(offer, cut.port), target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_byte_that_was_damaged_on_the_way_is_sent_again(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with wire(offer.port, Fault(after=1_000_000, flips=True)) as damaging:
        fetched = fetch(through(offer, damaging.port), target, timeout=PATIENCE)
    assert digests(target) == digests(source)
    assert fetched.resumed == 1


def test_a_wire_that_damages_every_time_is_given_up(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with (
        wire(offer.port, for_each=lambda _: Fault(after=20_000, flips=True)) as damaging,
        pytest.raises(TransferError, match=r"was cut after .* it broke again and again"),
    ):
        fetch(through(offer, damaging.port), target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_silent_source_is_given_up_in_time(source, target, sender):
    """Stopped in the middle: it neither sends nor closes."""
    offer = sender.offer(source, seconds=PATIENCE, max_rate=500e3)
    with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
        going = threads.submit(fetcher.fetch, offer, target, timeout=3.0)
        try:
            until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
            os.kill(sender._process.pid, signal.SIGSTOP)
            with pytest.raises(TransferError, match=r"was cut after|took longer than 3 s"):
                going.result(PATIENCE)
        finally:
            os.kill(sender._process.pid, signal.SIGCONT)
    assert nothing_left(target)


def test_a_transfer_that_takes_too_long_is_given_up(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE, max_rate=500e3)
    with pytest.raises(TransferError, match=r"took longer than 1 s: \d+ of \d+ bytes had come"):
        fetch(offer, target, timeout=1.0)
    assert nothing_left(target)


def test_nobody_at_any_address(source, target, sender):
    """All of them are named."""
    offer = sender.offer(source, seconds=PATIENCE)
    sender.close()
    with pytest.raises(TransferError) as caught:
        fetch(offer, target, timeout=PATIENCE)
    for address in offer.addresses:
        assert f"{address}:{offer.port}: connection refused" in str(caught.value)
    assert nothing_left(target)


def test_an_offer_ends_by_itself(source, target, sender):
    offer = sender.offer(source, seconds=0.2)
    assert sender.wait(PATIENCE) == Sent("expired", 0)
    assert not listens(offer.port)
    with pytest.raises(TransferError, match=r"its offer, which stands for 0\.2 s, may be over"):
        fetch(offer, target, timeout=PATIENCE)


def test_an_offer_that_ends_in_mid_transfer(source, target, sender):
    offer = sender.offer(source, seconds=1.0, max_rate=500e3)
    with pytest.raises(TransferError, match=r"was cut after|cannot be reached"):
        fetch(offer, target, timeout=PATIENCE)
    assert sender.close().outcome == "expired"
    assert nothing_left(target)


def test_files_that_changed_since_they_were_offered_are_refused(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    (source / "pages" / "1.img").write_bytes(b"other")
    with pytest.raises(TransferError, match=r"refuses .*1\.img has changed since it was offered"):
        fetch(offer, target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_directory_that_is_gone_since_it_was_offered(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    source.rename(source.with_name("elsewhere"))
    with pytest.raises(TransferError, match=r"refuses .* is gone"):
        fetch(offer, target, timeout=PATIENCE)


def test_a_directory_that_is_not_there_is_not_offered(tmp_path, sender):
    with pytest.raises(TransferError, match="is gone, or was never there"):
        sender.offer(tmp_path / "none", seconds=PATIENCE)


# --- a source that is not what it should be --------------------------------------------------


@contextlib.contextmanager
def lying(directory: Path) -> Iterator[Offer]:
    """Serves in this process, where a test may put something else in the place of its parts."""
    made: queue.Queue[Offer] = queue.Queue()

    async def run() -> None:
        stop = asyncio.Event()
        ends.append((asyncio.get_running_loop(), stop))
        await serve(
            directory, seconds=PATIENCE, max_rate=0, loopback=True, to="", announce=made.put,
            withdrawn=stop,
        )  # fmt: skip

    ends: list = []
    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    try:
        yield made.get(timeout=PATIENCE)
    finally:
        loop, stop = ends[0]
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE)


def assert_refused(source: Path, target: Path, why: str) -> None:
    with lying(source) as offer, pytest.raises(TransferError, match=why):
        fetch(offer, target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_wrong_checksum_is_noticed(source, target, monkeypatch):
    monkeypatch.setattr(archive, "new_digest", lambda: hashlib.blake2b(b"other", digest_size=32))
    assert_refused(source, target, r"does not match its checksum")


def test_an_archive_that_leaves_its_directory_is_refused(source, target, tmp_path, monkeypatch):
    """Whoever has made it, and though its checksum is right."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as tar:
        entry = tarfile.TarInfo("../../outside")
        entry.size = 5
        tar.addfile(entry, io.BytesIO(b"12345"))
    monkeypatch.setattr(Archive, "pieces", lambda self, start: iter([made.getvalue()]))
    assert_refused(source, target, r"'\.\./\.\./outside', which lies outside")
    assert not (tmp_path / "outside").exists()


def test_no_more_is_taken_than_was_offered(source, target, monkeypatch):
    """What had no end would fill the disk."""
    offered = Archive(source)
    head = next(offered.pieces())

    def endless(self, start):
        entry = tarfile.TarInfo("endless")
        entry.size = 1 << 40
        return itertools.chain([entry.tobuf()], itertools.repeat(bytes(1 << 16)))

    assert len(head) < offered.length
    monkeypatch.setattr(Archive, "pieces", endless)
    assert_refused(source, target, r"no sound archive|ends within 'endless'")


def test_a_stream_that_is_no_zstandard_is_refused(source, target, monkeypatch):
    monkeypatch.setattr(serving, "compressed", lambda pieces: iter([b"plain" * 1000]))
    assert_refused(source, target, r"what came from 127\.0\.0\.1 is damaged")


def test_a_stream_that_always_ends_too_soon_is_given_up(source, target, monkeypatch):
    monkeypatch.setattr(Archive, "pieces", lambda self, start: iter([bytes(100)]))
    assert_refused(source, target, r"the stream ended too soon|no sound archive")


# --- disks -----------------------------------------------------------------------------------


def test_what_has_no_room_is_not_begun(source, sender, tmp_path):
    """The source's offer still stands for a place with more room."""
    offer = sender.offer(source, seconds=PATIENCE)
    with small_disk(tmp_path / "disk") as disk:
        with pytest.raises(TransferError, match=r"do not fit .* the file system .*/disk has"):
            fetch(offer, disk.place / "target", timeout=PATIENCE, reserve=0)
        assert list(disk.place.iterdir()) == []
    fetch(offer, tmp_path / "target", timeout=PATIENCE)


def test_a_reserve_stays_free(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with pytest.raises(TransferError, match=r"are to stay free, and the file system"):
        fetch(offer, target, timeout=PATIENCE, reserve=1 << 60)
    assert nothing_left(target)


def test_a_disk_that_is_full_meanwhile(sender, tmp_path):
    """Others write too: what came is removed, and the error names the file system."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "pages").write_bytes(random.Random(7).randbytes(600_000))
    with small_disk(tmp_path / "disk") as disk:
        offer = sender.offer(source, seconds=PATIENCE, max_rate=200e3)
        with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
            going = threads.submit(
                fetcher.fetch, offer, disk.place / "target", timeout=PATIENCE, reserve=0
            )
            until("something has come", lambda: list(disk.place.glob(".rosrm-fetch-*/*")))
            disk.fill()
            with pytest.raises(TransferError, match=r"No space left on device; the file system"):
                going.result(PATIENCE)
        assert [path.name for path in disk.place.iterdir()] == ["filler"]
